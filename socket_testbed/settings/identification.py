"""Settings of the identification, of the plateaus of a trial, and of the force map."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Literal, get_args

from socket_testbed.errors import ConfigurationError, closest
from socket_testbed.settings.fields import Settings, renew_choices, setting

Variant = Literal["stiffness", "stiffness_bias", "rigid", "rigid_bias"]
PAPER_VARIANTS: tuple[Variant, ...] = ("stiffness", "stiffness_bias")
VARIANTS: list[str] = [*get_args(Variant)]  # and those of `add_variant`
BIAS_VARIANTS = ["stiffness_bias", "rigid_bias"]
Weights = Literal["size", "noise", "raw"]


def add_variant(name: str, offsets: bool) -> None:
    """Accept a variant that the package does not have; `contact.register_law` gives it a law.

    Args:
        name: The variant; one that was added before is added anew.
        offsets: Whether its models have constant offsets of the sensors.

    Raises:
        ConfigurationError: If it is a variant of the package, or no name.
    """
    taken = name in get_args(Variant)
    if taken or not str(name).isidentifier():
        why = "that of one of the package's" if taken else "no identifier"
        fact = f"the law's name '{name}' is {why}"
        raise ConfigurationError(fact, "give it a name of its own, such as 'hardening'")
    for names, listed in ((VARIANTS, True), (BIAS_VARIANTS, offsets)):
        names[:] = [other for other in names if other != name] + [name] * listed
    renew_choices()


def check_solver(solver: str) -> None:
    """Check that a solver is installed; a model may name one that is not.

    Raises:
        ConfigurationError: If qpsolvers does not find the solver on this machine.
    """
    import qpsolvers  # imported late: it imports every solver

    installed = qpsolvers.available_solvers
    if solver not in installed:
        hint = closest(solver, installed)
        if solver == IdentificationSettings.solver:
            hint = f"install requirements/runtime.txt for {sys.executable}, or {hint}"
        raise ConfigurationError(f"solver '{solver}' is not installed", hint)


@dataclass(frozen=True)
class IdentificationSettings(Settings):
    """Settings of the two-stage identification of the contact model."""

    variant: str = setting(
        "rigid_bias",
        "the law: stiffness as published, rigid by the limb's pose; _bias with offsets [-]",
        choices=VARIANTS,
    )
    theta: float = setting(
        0.5, "weight of the wrench against the clusters, on normalised errors [-]", 0.0, 1.0
    )
    weights: str = setting(
        "size", "weights of the channels within a group: by size, by noise, or equal (raw) [-]",
        choices=get_args(Weights),
    )  # fmt: skip
    gate_sharpness: float = setting(2000.0, "sharpness alpha of the gate [1/m]", 1.0, 1e6)
    initial_stiffness: float = setting(
        3000.0, "stiffness k0 of every spring in Stage 1; auto or 0: from the trial's slope [N/m]",
        0.0, 1e7, auto=0.0,
    )  # fmt: skip
    reference_position: tuple[float, ...] = setting(
        (), "q_ref, centre of the box of rest positions; empty: the mean position [m]", -10.0, 10.0
    )
    rest_position_limit: float = setting(
        0.008, "largest distance of a rest position from q_ref, per axis [m]", 1e-5, 0.1
    )
    smoothness: float = setting(
        1e-3, "weight of the smoothness over neighbouring tiles against the errors [-]", 0.0, 1e6
    )
    stiffness_difference: float = setting(
        1000.0, "expected difference of stiffness between neighbours [N/m]", 1e-3, 1e7
    )
    rest_position_difference: float = setting(
        0.002, "expected difference of rest position between neighbours [m]", 1e-6, 0.1
    )
    contact_sharpness: float = setting(
        1000.0, "sharpness alpha of the rigid variants' contact [1/m]", 1.0, 1e6
    )
    prior: float = setting(
        1.0, "weight of the rigid variants' prior over the tiles against the errors [-]", 1e-9, 1e6
    )
    leave_out: tuple[str, ...] = setting(
        (), "channels to leave out, such as distal.Fx or Mz; distal leaves out all of a cluster [-]"
    )
    frames: int = setting(
        0, "samples from the segment's start that offline fits use; 0: all [1]", 0, 10_000_000
    )
    pose_smoothing: float = setting(
        0.0, "centred window of the mean pose in offline fits; 0: none [s]", 0.0, 60.0
    )
    solver: str = setting("osqp", "solver of the quadratic programs: any that qpsolvers finds [-]")
    solver_tolerance: float = setting(
        1e-8, "largest KKT residual of a solution, in scaled units [-]", 1e-12, 1e-2
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.reference_position) not in (0, 3):
            raise ConfigurationError(
                f"reference_position has {len(self.reference_position)} numbers",
                "give x, y and z in m, or none for the mean limb position",
            )


@dataclass(frozen=True)
class PlateauSettings(Settings):
    """Criteria for steady plateaus of a trial."""

    smoothing: float = setting(2.0, "window of the moving mean of the wrench [s]", 0.05, 60.0)
    force_change: float = setting(
        8.0, "difference of the mean force that counts as a change of load [N]", 0.1, 1e4
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
        0.2, "largest fraction of missing channels in the moving window [-]", 0.0, 1.0
    )
    least_force: float = setting(
        20.0, "smallest mean force; unloaded data gives no information on contact [N]", 0.0, 1e4
    )
    least_duration: float = setting(5.0, "shortest plateau [s]", 0.1, 1e5)


MIN_SHARE = 0.2  # [-]; smallest share of the load borne by the tiles


@dataclass(frozen=True)
class ForceMapSettings(Settings):
    """The prior of the force map: sizes of the forces on tiles and of the channels' errors.

    Values that the data adjusts are medians or means; sizes are standard deviations.
    """

    normal_deviation: float = setting(
        4.5, "typical size of a tile's own normal force; scaled by the data [N]", 1e-3, 1e4
    )
    length: float = setting(0.08, "correlation length of the forces [m]", 1e-3, 1.0)
    shear: float = setting(
        0.2, "a tile's own tangential force, relative to its own normal force [-]", 1e-3, 1e2
    )
    length_spread: float = setting(0.5, "deviation of log(length) [-]", 0.0, 1.0)
    preload: float = setting(
        1.2, "normal force common to all tiles, relative to normal_deviation [-]", 1e-3, 1e2
    )
    bed: float = setting(
        0.5,
        "forces of a bed of springs as the limb moves sideways, relative to normal_deviation [-]",
        1e-3,
        1e2,
    )
    sinking: float = setting(
        1.4,
        "forces of a bed of springs as the limb sinks, relative to normal_deviation [-]",
        1e-3,
        1e2,
    )
    rotation: float = setting(
        0.15,
        "forces of a bed of springs as the limb turns, relative to normal_deviation [-]",
        1e-3,
        1e2,
    )
    bed_shear: float = setting(
        0.15, "tangential stiffness of the bed, relative to its normal stiffness [-]", 1e-3, 1e1
    )
    bed_variation: float = setting(
        0.7,
        "variation of the bed's stiffness over the surface, relative to its mean [-]",
        1e-3,
        1e1,
    )
    arm: float = setting(
        0.06, "lever arm that makes a rotation comparable to a translation [m]", 1e-3, 1.0
    )
    drag: float = setting(
        0.1, "distal force on a tile by friction, relative to its normal force [-]", -1.0, 1.0
    )
    drag_spread: float = setting(0.1, "standard deviation of drag [-]", 0.0, 0.5)
    share: float = setting(
        0.88,
        "mean share of the load borne by the tiles, for a socket.yaml without tile_share [-]",
        MIN_SHARE,
        1.0,
    )
    share_spread: float = setting(
        0.07, "standard deviation of share, for a socket.yaml without tile_share [-]", 0.0, 0.3
    )
    moment_error: float = setting(
        0.7, "offset of a moment, including the surface between tiles [N m]", 1e-6, 1e2
    )
    force_error: float = setting(
        4.0,
        "offset of a force of the load cell, including the surface between tiles [N]",
        1e-6,
        1e3,
    )
    cluster_error: float = setting(0.3, "offset of a force on a cluster [N]", 1e-6, 1e3)
    cluster_gain_error: float = setting(0.05, "error of a cluster's gain [-]", 0.0, 1.0)
    cluster_error_spread: float = setting(1.0, "deviation of log(cluster_error) [-]", 0.0, 3.0)
    spread: float = setting(
        1.0,
        "deviation of log(size) of shear, preload, bed, sinking, rotation, bed_shear and"
        " bed_variation [-]",
        0.0,
        2.0,
    )
    draws: int = setting(
        64, "hypotheses drawn from these distributions; 1: the given values only [1]", 1, 1024
    )
