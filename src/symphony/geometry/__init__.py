"""Pure batched tensor functions: frames, oriented boxes, signed distances."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.geometry.boxes import box_corners as box_corners
    from symphony.geometry.boxes import box_gap as box_gap
    from symphony.geometry.boxes import boxes_overlap as boxes_overlap
    from symphony.geometry.boxes import contact_share as contact_share
    from symphony.geometry.boxes import meeting_time as meeting_time
    from symphony.geometry.boxes import pose_at as pose_at
    from symphony.geometry.frames import LEVEL as LEVEL
    from symphony.geometry.frames import forward_speed as forward_speed
    from symphony.geometry.frames import levels_apart as levels_apart
    from symphony.geometry.frames import rotate as rotate
    from symphony.geometry.frames import with_speed as with_speed
    from symphony.geometry.frames import wrap as wrap
    from symphony.geometry.polylines import NO_BOUNDARY as NO_BOUNDARY
    from symphony.geometry.polylines import segments_of as segments_of
    from symphony.geometry.polylines import signed_distance as signed_distance

__getattr__, __dir__ = lazily(__name__)
__all__ = __dir__()  # noqa: PLE0605
