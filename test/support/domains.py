"""ROS domains that a run of the tests has for itself."""

import os
import socket
import time

_LAST = 101  # the ports of higher domains may be taken by any program
_HAUNTED = 30.0  # [s]; others take a killed node for a silent one for 20 s
_MAX_PARTICIPANTS = 32  # of a domain, that discovery on one machine looks for

_claims: list[tuple[socket.socket, float]] = []  # with when the next one was made [s]


def is_silent(domain: int) -> bool:
    """Whether no program on this machine listens for discovery in a ROS domain.

    Each participant has a UDP port of its own (OMG, DDSI-RTPS 2.5, section 9.6.2).
    """
    first = 7400 + 250 * domain + 10
    for number in range(_MAX_PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", first + 2 * number))
            except OSError:
                return False
    return True


def claim_domain() -> str:
    """A ROS domain that no other test on this machine has, and none had a moment ago.

    Nor is any other program's node in it: a graph that somebody runs beside the tests knows nothing
    of their claims. A claim is kept until the process ends, or for a while after the next one. An
    abstract address of Unix sockets exists once per network namespace, as a domain does, and is
    free again however its process ends.
    """
    now = time.monotonic()
    while len(_claims) > 1 and _claims[0][1] < now - _HAUNTED:
        _claims.pop(0)[0].close()
    if _claims:
        _claims[-1] = _claims[-1][0], now
    for k in range(_LAST):
        domain = 1 + (os.getpid() + k) % _LAST
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0socket_testbed tests in ROS domain {domain}")
        except OSError:
            claim.close()
            continue
        if not is_silent(domain):
            claim.close()
            continue
        _claims.append((claim, now))
        return str(domain)
    raise RuntimeError("all ROS domains are taken: wait until other runs of the tests have ended")
