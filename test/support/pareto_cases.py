"""Problems whose front is known to be sound, and fronts that are made up."""

import numpy as np

from socket_testbed.identification.pareto import FrontPoint, make_front
from socket_testbed.settings.identification import IdentificationSettings
from support.problems import moving_limb, random_bed, random_socket, samples_of_bed

CHANNELS = ("Mx", "Fx", "Fz", "distal.Fx", "distal.Mz", "distal.Fz")
THETAS = (0.0, 0.07, 0.5, 0.93, 1.0)


def make_hold(seed):
    """A hold with sensor noise, on which the data determine little, and its settings."""
    rng = np.random.default_rng(seed)
    geometry = random_socket(rng, rings=3, columns=5)
    bed = random_bed(rng, geometry, "stiffness_bias", untouched=0.3)
    position = bed.rest_positions.mean(axis=0) + moving_limb(rng, 60, 1e-4)
    samples = samples_of_bed(rng, bed, position, noise=1.0)
    return geometry, bed, samples, IdentificationSettings(smoothness=1e-4)


def made_up_front(variant="stiffness", scale=1.0, flaws=(), channels=CHANNELS):
    """A hyperbola with its corner at theta 0.4, dominated from theta 0.9 on."""
    points = []
    for i, t in enumerate(np.linspace(0.0, 1.0, 11)):
        errors = (0.1 + 0.01 / (t + 0.01), 0.1 + 0.01 / (0.81 - t)) if i < 9 else (2.0 + t, 2.0)
        wrench, local = scale * errors[0], scale * errors[1]
        rmse = np.arange(1.0, 1.0 + len(channels)) * (1.0 + t)
        flaw = dict(flaws).get(i, "")
        if flaw == "not certified":
            wrench = local = np.nan
            rmse = rmse * np.nan
        points.append(FrontPoint(float(t), None, rmse, wrench, local, 1e-12 * (i + 1), flaw))
    return make_front(variant, channels, points)
