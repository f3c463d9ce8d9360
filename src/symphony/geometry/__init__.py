"""Pure batched tensor functions: frames, oriented boxes, signed distances."""

from __future__ import annotations

from symphony.geometry.boxes import box_corners, box_gap, boxes_overlap
from symphony.geometry.contact import contact_share, meeting_time, pose_at
from symphony.geometry.frames import forward_speed, rotate, with_speed, wrap
from symphony.geometry.levels import LEVEL, levels_apart
from symphony.geometry.polylines import NO_BOUNDARY, segments_of, signed_distance

__all__ = [
    "LEVEL",
    "NO_BOUNDARY",
    "box_corners",
    "box_gap",
    "boxes_overlap",
    "contact_share",
    "forward_speed",
    "levels_apart",
    "meeting_time",
    "pose_at",
    "rotate",
    "segments_of",
    "signed_distance",
    "with_speed",
    "wrap",
]
