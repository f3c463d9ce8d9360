"""Planners that drive the ego: what they are told, how they are asked, and two that come with the package."""
