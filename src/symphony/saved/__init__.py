"""Rollouts on disk: the format, writing, reading and export to other tools."""
