"""Per-step realism of rollouts: collisions, off-road driving, distance from the log (section V of the paper).

Metres and radians. T are the simulated steps: the first state, where rollout and log are equal by construction, is
left out by the caller. Legend: A agents, N interactive agents, E boundary segments.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.geometry import box_corners, boxes_overlap, signed_distance

_SLACK = 1e-3


def collisions(
    position: Float[Tensor, "*#lead A T 2"],
    heading: Float[Tensor, "*#lead A T"],
    size: Float[Tensor, "*#lead A 2"],
    valid: Bool[Tensor, "*#lead A T"],
    subject: Int[Tensor, "*#lead N"],
) -> Bool[Tensor, "*lead N T"]:
    """Whether the oriented box of each subject overlaps that of any other valid agent, per step.

    Boxes that only touch do not overlap. Leading dimensions broadcast.

    Args:
        position: [..., A, T, 2] box centres.
        heading: [..., A, T].
        size: [..., A, 2] length and width.
        valid: [..., A, T]; a subject that is not valid collides with nothing, whatever the other numbers are.
        subject: [..., N] indices into A; a negative one stands for no agent.
    """
    lead = torch.broadcast_shapes(
        position.shape[:-3], heading.shape[:-2], size.shape[:-2], valid.shape[:-2], subject.shape[:-1]
    )
    agents, steps = valid.shape[-2:]
    position = position.expand(*lead, agents, steps, 2).reshape(-1, agents, steps, 2)
    heading = heading.expand(*lead, agents, steps).reshape(-1, agents, steps)
    valid = valid.expand(*lead, agents, steps).reshape(-1, agents, steps)
    size = size.expand(*lead, agents, 2).reshape(-1, agents, 2)
    subject = subject.expand(*lead, subject.shape[-1]).reshape(-1, subject.shape[-1])

    scene = torch.arange(len(position), device=position.device)[:, None]
    index = subject.clamp(min=0)
    other = subject[..., None] != torch.arange(agents, device=position.device)
    pairs = valid[:, None] & valid[scene, index][:, :, None] & (other & (subject >= 0)[..., None])[..., None]
    # Boxes can only overlap where the circles around them do: of all pairs few are left to look at closely.
    radius = 0.5 * size.norm(dim=-1)
    reach = radius[scene, index][..., None] + radius[:, None] + _SLACK
    away = position[:, None] - position[scene, index][:, :, None]
    pairs &= away.square().sum(-1) <= reach.square()[..., None]

    row, who, agent, step = pairs.nonzero(as_tuple=True)
    first = index[row, who]
    overlap = boxes_overlap(
        position[row, first, step],
        heading[row, first, step],
        size[row, first],
        position[row, agent, step],
        heading[row, agent, step],
        size[row, agent],
    )
    result = torch.zeros(*subject.shape, steps, dtype=torch.bool, device=position.device)
    result[row[overlap], who[overlap], step[overlap]] = True
    return result.reshape(*lead, subject.shape[-1], steps)


def offroad(
    position: Float[Tensor, "B *rest 2"],
    start: Float[Tensor, "B E 2"],
    end: Float[Tensor, "B E 2"],
    valid: Bool[Tensor, "B E"],
    previous: Int[Tensor, "B E"] | None = None,
    following: Int[Tensor, "B E"] | None = None,
    *,
    heading: Float[Tensor, " B *rest"] | None = None,
    size: Float[Tensor, "B *#rest 2"] | None = None,
) -> Bool[Tensor, " B *rest"]:
    """Whether boxes are off the drivable area.

    By their centre or, where ``heading`` and ``size`` are given, by any of their corners. The boundary is that of
    :func:`symphony.geometry.signed_distance`; a point on it is not off the road.
    """
    shape = position.shape[:-1]
    if heading is None or size is None:
        if heading is not None or size is not None:
            raise ValueError("corners need both heading and size")
        points = position[..., None, :]
    else:
        points = box_corners(position, heading, size)
    flat = points.reshape(len(position), -1, 2)
    with torch.no_grad():
        distance = signed_distance(flat, start, end, valid, previous, following)
    return (distance > 0).reshape(*shape, points.shape[-2]).any(-1)


def displacement(
    position: Float[Tensor, "*#batch N T 2"],
    log: Float[Tensor, "*#batch N T 2"],
    valid: Bool[Tensor, "*#batch N T"],
) -> Float[Tensor, "*batch N T"]:
    """Euclidean distance to the logged position, 0 where the log is not valid. Leading dimensions broadcast."""
    away = torch.where(valid[..., None], position - log, 0.0)
    return torch.hypot(away[..., 0], away[..., 1])
