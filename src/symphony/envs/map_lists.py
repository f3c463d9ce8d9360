"""What can be nearest to a place of a map, listed once for the cells around its lanes, to be kept with the map.

Scenes that come with lists look things up in them; cells that have none get theirs when somebody comes there. Either
way the same points are found.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import PointType, SceneBatch
from symphony.envs.tables import Tables
from symphony.errors import DataError
from symphony.geometry.cell_lists import Whole, is_packed


class MapLists(NamedTuple):
    """Of one map, see :mod:`symphony.geometry.cell_lists`.

    Attributes:
        points: [W] int32, for the nearest points.
        edges: [V] int32, for the nearest edge of the road.
    """

    points: Whole
    edges: Whole

    @classmethod
    def of(cls, scene: SceneBatch, num_points: int) -> MapLists:
        """Those of a scene's map.

        Args:
            scene: one scene. Its lights are not of the map.
            num_points: nearest points that are looked for.
        """
        number = _map_points(scene)
        only = scene.replace(**{name: getattr(scene, name)[:, :number] for name in _POINT_FIELDS})
        tables = Tables(only, ObservationConfig(num_points=num_points))
        lane = only.point[0][only.point_type[0] == PointType.LANE].numpy()
        x, y = np.ascontiguousarray(lane.T)
        return cls(
            tables.point_cells.packed(x, y, number),
            tables.edge_cells.packed(x, y, scene.edge_valid.shape[1]),
        )

    def fit(self, scene: SceneBatch) -> bool:
        """Whether these can be a scene's."""
        return is_packed(self.points, _map_points(scene)) and is_packed(self.edges, scene.edge_valid.shape[1])

    def beside(self, scene: SceneBatch) -> SceneBatch:
        """The scene with these lists.

        Raises:
            DataError: they are of a map with other numbers of points or edges.
        """
        if not self.fit(scene):
            raise DataError("lists of near points are those of another map", field="point_lists")
        points, edges = (torch.from_numpy(lists)[None] for lists in self)
        return scene.replace(point_lists=points, edge_lists=edges)


_POINT_FIELDS = ("point", "point_direction", "point_type", "point_speed", "point_light", "point_valid")
_EDGE_FIELDS = ("edge_start", "edge_end", "edge_previous", "edge_following")


def map_parts(scene: SceneBatch) -> list[NDArray[Any]]:
    """All that the lists of a scene's map depend on."""
    number = _map_points(scene)
    points = [getattr(scene, name)[0, :number].numpy() for name in ("point", "point_type")]
    return points + [getattr(scene, name)[0].numpy() for name in _EDGE_FIELDS]


def _map_points(scene: SceneBatch) -> int:
    """Points of a scene's map, which come before its lights."""
    return int((scene.point_type[0] != PointType.LIGHT).sum())
