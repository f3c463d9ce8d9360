"""The Waymo Open Sim Agents Challenge: its scorer, rollouts for it, and submissions to it."""
