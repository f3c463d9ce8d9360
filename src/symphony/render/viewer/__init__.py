"""Saved rollouts as one page that plays them in a browser, without a network."""

from __future__ import annotations

from symphony.render.viewer.pack import Event, Replay, packed, view_page

__all__ = ["Event", "Replay", "packed", "view_page"]
