"""What a submission to the challenge says about itself; imports nothing heavy, so that ``--help`` can ask for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SubmissionMeta:
    """What a submission says about itself; there are no defaults for what only its authors can answer.

    Attributes:
        account_name: E-mail address registered with the challenge.
        unique_method_name: Short name on the leaderboard.
        uses_lidar_data: Whether the model uses lidar data.
        uses_camera_data: Whether the model uses camera data.
        uses_public_model_pretraining: Whether public models were used for pre-training.
        num_model_parameters: Number of parameters with a suffix, such as `200K`.
        acknowledge_complies_with_closed_loop_requirement: Whether every step was simulated from those before it.
        authors: Names of the authors.
        affiliation: Affiliation of the authors.
        description: Description of the method.
        method_link: A page on the method.
        public_model_names: Names of the public models.
    """

    account_name: str
    unique_method_name: str
    uses_lidar_data: bool
    uses_camera_data: bool
    uses_public_model_pretraining: bool
    num_model_parameters: str
    acknowledge_complies_with_closed_loop_requirement: bool
    authors: tuple[str, ...] = ()
    affiliation: str = ""
    description: str = ""
    method_link: str = ""
    public_model_names: tuple[str, ...] = ()
