"""How the contact model is identified, and what counts as a steady stretch of a trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from socket_testbed.settings.fields import Settings, setting

Variant = Literal["stiffness", "stiffness_bias"]
VARIANTS: tuple[Variant, ...] = get_args(Variant)


@dataclass(frozen=True)
class IdentificationSettings(Settings):
    """How the contact model is identified (the two stages)."""

    variant: str = setting(
        "stiffness_bias",
        "which offsets the model has: stiffness none, stiffness_bias one per channel [-]",
        choices=VARIANTS,
    )
    theta: float = setting(
        0.5, "weight of the wrench against the clusters, on normalised errors [-]", 0.0, 1.0
    )
    gate_sharpness: float = setting(
        2000.0, "sharpness alpha of the unilateral gate [1/m]", 1.0, 1e6
    )
    initial_stiffness: float = setting(
        3000.0, "stiffness k0 of every spring in Stage 1 [N/m]", 1.0, 1e7
    )
    rest_position_limit: float = setting(
        0.008, "largest distance of a rest position from the mean limb position, per axis [m]",
        1e-5, 0.1,
    )  # fmt: skip
    smoothness: float = setting(
        1e-3, "weight of the smoothness over neighbouring tiles against the errors [-]", 0.0, 1e6
    )
    stiffness_difference: float = setting(
        1000.0, "expected difference of stiffness between neighbours [N/m]", 1e-3, 1e7
    )
    rest_position_difference: float = setting(
        0.002, "expected difference of rest position between neighbours [m]", 1e-6, 0.1
    )
    leave_out: tuple[str, ...] = setting(
        (), "channels left out of the objective, such as distal.Fx or Mz [-]"
    )
    pose_smoothing: float = setting(
        0.0, "centred window of the mean pose in offline fits and evaluations; 0: none [s]",
        0.0, 60.0,
    )  # fmt: skip
    solver: str = setting("osqp", "any installed solver that qpsolvers supports [-]")
    solver_tolerance: float = setting(
        1e-8, "largest KKT residual that a solution may have, in scaled units [-]", 1e-12, 1e-2
    )


@dataclass(frozen=True)
class PlateauSettings(Settings):
    """What counts as a steady stretch of a trial."""

    smoothing: float = setting(2.0, "window of the moving mean of the wrench [s]", 0.05, 60.0)
    force_change: float = setting(
        8.0, "difference of the mean force that counts as an intended change of load [N]", 0.1, 1e4
    )
    moment_change: float = setting(
        0.8, "difference of the mean moment that counts as a change of load [N m]", 0.01, 1e3
    )
    force_drift: float = setting(
        10.0, "largest spread of the mean force within a plateau [N]", 0.1, 1e4
    )
    moment_drift: float = setting(
        1.0, "largest spread of the mean moment within a plateau [N m]", 0.01, 1e3
    )
    cluster_change: float = setting(
        3.0, "difference of the mean force on a cluster that counts as a change [N]", 0.01, 1e4
    )
    cluster_drift: float = setting(
        5.0, "largest spread of the mean force on a cluster within a plateau [N]", 0.01, 1e4
    )
    missing_fraction: float = setting(
        0.2, "largest fraction of missing channels within the moving window [-]", 0.0, 1.0
    )
    least_force: float = setting(
        20.0, "smallest mean force: an unloaded stretch says nothing about contact [N]", 0.0, 1e4
    )
    least_duration: float = setting(5.0, "shortest plateau [s]", 0.1, 1e5)
