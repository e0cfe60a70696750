"""What tests share: sockets, trials, buses and graphs to test with."""

from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
# Real data that nobody here wrote, where it lies beside the checkout.
SHARED_DATA = CHECKOUT.parent / "shared" / "data"
# What takes longer than this hangs [s]; each test has 120 s in all.
HANGS = 90.0
