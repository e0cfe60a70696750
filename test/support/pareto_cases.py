"""Fronts that are made up."""

import numpy as np

from socket_testbed.identification.pareto import FrontPoint, make_front

CHANNELS = ("Mx", "Fx", "Fz", "distal.Fx", "distal.Mz", "distal.Fz")
THETAS = (0.0, 0.07, 0.5, 0.93, 1.0)


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
