"""A ROS domain for each process that runs tests."""

import os
import socket

_LAST = 101  # the ports of higher domains may be taken by any program

_claims: list[socket.socket] = []


def claim_domain() -> str:
    """A ROS domain that no other run of the tests on this machine has; kept until the process ends.

    An abstract address of Unix sockets exists once per network namespace, as a domain does, and is
    free again however its process ends.

    Raises:
        RuntimeError: If all domains are taken.
    """
    for k in range(_LAST):
        domain = 1 + (os.getpid() + k) % _LAST
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0socket_testbed tests in ROS domain {domain}")
        except OSError:
            claim.close()
            continue
        _claims.append(claim)
        return str(domain)
    raise RuntimeError("all ROS domains are taken: wait until other runs of the tests have ended")
