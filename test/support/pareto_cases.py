"""Problems whose front is known to be sound."""

import numpy as np

from socket_testbed.settings.identification import IdentificationSettings
from support.problems import moving_limb, random_bed, random_socket, samples_of_bed

THETAS = (0.0, 0.07, 0.5, 0.93, 1.0)


def make_hold(seed):
    """A hold with sensor noise, on which the data determine little, and its settings."""
    rng = np.random.default_rng(seed)
    geometry = random_socket(rng, rings=3, columns=5)
    bed = random_bed(rng, geometry, "stiffness_bias", untouched=0.3)
    position = bed.rest_positions.mean(axis=0) + moving_limb(rng, 60, 1e-4)
    samples = samples_of_bed(rng, bed, position, noise=1.0)
    return geometry, bed, samples, IdentificationSettings(smoothness=1e-4)
