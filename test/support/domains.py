"""ROS domains for the tests, which run side by side on a machine."""

import os
import socket
import time

_LAST = 101  # the ports of higher domains may be taken by any program
_HAUNTED = 30.0  # [s]; others take a killed node for a silent one for 20 s

_claims: list[tuple[socket.socket, float]] = []  # with when the next one was made [s]


def claim_domain() -> str:
    """A ROS domain that no other test on this machine has, and none had a moment ago.

    It is kept until the process ends, or for a while after the next one is claimed. An abstract
    address of Unix sockets exists once per network namespace, as a domain does, and is free again
    however its process ends.
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
        _claims.append((claim, now))
        return str(domain)
    raise RuntimeError("all ROS domains are taken: wait until other runs of the tests have ended")
