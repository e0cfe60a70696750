from socket_testbed.clocks import Backoff


def test_the_waits_double_up_to_the_longest_and_a_success_ends_them() -> None:
    backoff, now, waits = Backoff(0.4), 10.0, []
    assert backoff.due(now)
    for _ in range(6):
        backoff.failed(now)
        assert not backoff.due(now)
        waits.append(next(w for w in (0.05, 0.1, 0.2, 0.4) if backoff.due(now + w + 1e-9)))
        now += 1.0
    assert waits == [0.05, 0.1, 0.2, 0.4, 0.4, 0.4]
    backoff.succeeded()
    assert backoff.due(now)
