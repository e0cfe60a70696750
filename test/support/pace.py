"""How fast a test lets a simulated testbed run."""

from socket_testbed.live.machine import SLOWEST, measure_speed


def careful_time_scale() -> float:
    """What this machine manages, on a busy one with a reserve for what starts meanwhile [-]."""
    scale = measure_speed().time_scale()
    return scale if scale == 1.0 else max(0.5 * scale, SLOWEST)
