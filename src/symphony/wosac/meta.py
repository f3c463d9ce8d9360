"""The metadata of a submission to the challenge; imports nothing heavy, so that ``--help`` can ask for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SubmissionMeta:
    """The metadata of a submission; there are no defaults for what only its authors can answer."""

    account_name: str  # E-mail address registered with the challenge.
    unique_method_name: str  # Short name on the leaderboard.
    uses_lidar_data: bool  # Whether the model uses lidar data.
    uses_camera_data: bool  # Whether the model uses camera data.
    uses_public_model_pretraining: bool  # Whether public models were used for pre-training.
    num_model_parameters: str  # Number of parameters with a suffix, such as `200K`.
    #: Whether every step was simulated from those before it.
    acknowledge_complies_with_closed_loop_requirement: bool
    authors: tuple[str, ...] = ()  # Names of the authors.
    affiliation: str = ""  # Affiliation of the authors.
    description: str = ""  # Description of the method.
    method_link: str = ""  # A page on the method.
    public_model_names: tuple[str, ...] = ()  # Names of the public models.
