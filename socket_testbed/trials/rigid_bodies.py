"""Messages of the rigid bodies that a motion capture tracks, as the drivers of mocap4r2 send them.

Their definition changed over the years, so that of the recording counts, or that of the package
that ROS has.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from socket_testbed.errors import TrialError, likely, listed
from socket_testbed.trials.bag import RawMessage
from socket_testbed.wire import cdr

BODIES = ("mocap4r2_msgs/msg/RigidBodies", "mocap_msgs/msg/RigidBodies")  # its earlier name
_MAX_LISTED = 4


class TrackedBody(NamedTuple):
    """A body in a message.

    Attributes:
        name: Its name.
        stamp: Its stamp, or that of the message, by the source's clock [ns]; 0 without any.
        frame: Its frame, or that of the message.
        pose: Position [m] and quaternion x, y, z, w [-]; empty while it is out of sight.
    """

    name: str
    stamp: int
    frame: str
    pose: list[float]


def require_definition(message: RawMessage) -> None:
    """Refuse a message whose type is not known.

    Args:
        message: The message.

    Raises:
        TrialError: If the recording states no definition of it, or one that cannot be read.
    """
    try:
        cdr.types_of(message.type, message.definition)
    except ValueError as error:
        package = message.type.partition("/")[0]
        hint = f"convert the bag with 'ros2 bag convert' to MCAP where {package} is installed"
        fact = f"{message.topic}: {error}"
        raise TrialError(fact, f"{hint}, or name other poses, or none") from None


def each_decoded(
    messages: Sequence[RawMessage], notes: list[str]
) -> Iterator[tuple[RawMessage, Any]]:
    """Messages of one type, each with its content, whatever their layouts.

    Args:
        messages: One or more messages.
        notes: Gets a line about messages that cannot be decoded.

    Raises:
        TrialError: If the definition of their type is not known.
    """
    require_definition(messages[0])
    refused = 0
    for message in messages:
        try:
            yield message, cdr.decode(message.data, message.type, message.definition)
        except Exception:  # the library may raise any exception
            refused += 1
    if refused:
        notes.append(f"{messages[0].topic}: {refused} messages cannot be decoded, and are left out")


def bodies_in(
    messages: Sequence[RawMessage], notes: list[str]
) -> Iterator[tuple[RawMessage, TrackedBody]]:
    """The bodies of messages of a type of `BODIES`.

    Args:
        messages: One or more messages.
        notes: Gets a line about messages that cannot be decoded.

    Raises:
        TrialError: If the definition of their type is not known.
    """
    for message, content in each_decoded(messages, notes):
        usual, frame = cdr.stamp_of(content), content.header.frame_id
        for body in content.rigidbodies:
            stamp, own_frame = 0, ""
            if hasattr(body, "header"):  # which most drivers leave empty
                stamp, own_frame = cdr.stamp_of(body), body.header.frame_id
            name, pose = body.rigid_body_name, _pose_of(body)
            yield message, TrackedBody(name, stamp or usual, own_frame or frame, pose)


def _pose_of(body: Any) -> list[float]:
    """Position [m] and quaternion x, y, z, w of a body; empty while it is out of sight.

    Of such a one drivers send zeros: all of them, or those of the position.
    """
    p, q = body.pose.position, body.pose.orientation
    position, orientation = [p.x, p.y, p.z], [q.x, q.y, q.z, q.w]
    return [*position, *orientation] if any(position) and any(orientation) else []


def body_names(messages: Sequence[RawMessage]) -> list[str]:
    """Names of the bodies in messages of a type of `BODIES`, in order of appearance.

    Args:
        messages: One or more messages.

    Raises:
        TrialError: If the definition of their type is not known.
    """
    return [*dict.fromkeys(body.name for _, body in bodies_in(messages, []))]


def lacking_body(body: str, messages: Sequence[RawMessage]) -> tuple[str, str]:
    """That messages have no pose of a body, as a fact and a hint.

    Args:
        body: Its name.
        messages: One or more messages of a type of `BODIES`.
    """
    topic, names = messages[0].topic, body_names(messages)
    if body in names:
        return f"{topic}: the body {body} is not tracked", "bring its markers into view"
    shown = listed(names, _MAX_LISTED) or "none"
    fact = f"{topic}: no body is called {body} (there are: {shown})"
    return fact, likely(body, names) or "name one of them, or bring it into view"
