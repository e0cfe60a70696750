"""The ROS domains of the tests are their own."""

import os

import pytest
import rclpy
from rclpy.context import Context
from support.domains import claim_domain, is_silent

pytestmark = pytest.mark.graph


def test_a_domain_with_a_node_is_not_claimed() -> None:
    """The domain that the next claim would take has a node of somebody else."""
    taken = int(claim_domain()) % 101 + 1
    context = Context()
    rclpy.init(context=context, domain_id=taken)
    node = rclpy.create_node("stranger", context=context)
    try:
        assert not is_silent(taken)
        assert claim_domain() != str(taken)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_each_claim_is_another_domain() -> None:
    assert len({claim_domain(), claim_domain(), os.environ["ROS_DOMAIN_ID"]}) == 3
