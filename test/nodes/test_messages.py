"""The messages are the contract's, for ROS and for the offline side, with a unit a field."""

import re

import pytest
from socket_testbed_msgs import msg
from support import CHECKOUT

from socket_testbed.trials.bag import typestore

FOLDER = CHECKOUT / "msg_defs" / "msg"
CONTRACT = {
    "Trigger": "std_msgs/Header header; uint64 sequence",
    "ClusterCapacitance": "string name; float64[4] capacitance; uint8[4] status",
    "ClusterCapacitanceArray": "std_msgs/Header header; ClusterCapacitance[] clusters",
    "LoadCellRaw": (
        "std_msgs/Header header; float64[6] ratios; geometry_msgs/Wrench tare;"
        " builtin_interfaces/Time tared; uint8 status"
    ),
    "RigidBodyMarkers": "string name; geometry_msgs/Point[] markers",
    "RigidBodyMarkersArray": "std_msgs/Header header; RigidBodyMarkers[] bodies",
    "ClusterStress": (
        "string name; float64 normal; float64 shear_x; float64 shear_y; uint8 status"
    ),
    "ClusterStressArray": "std_msgs/Header header; ClusterStress[] clusters",
    "LocalForceArray": ("std_msgs/Header header; string[] names; geometry_msgs/Vector3[] forces"),
    "ForceMap": (
        "std_msgs/Header header; string[] names; geometry_msgs/Vector3[] forces;"
        " geometry_msgs/Vector3[] standard_deviations; float64[] normal_pressure;"
        " float64[] normal_pressure_standard_deviation; float64[] shear;"
        " float64[] shear_standard_deviation; string source"
    ),
    "ContactModel": (
        "std_msgs/Header header; string variant; string[] names;"
        " geometry_msgs/Vector3[] stiffness; geometry_msgs/Vector3[] rest_positions;"
        " geometry_msgs/Wrench wrench_bias; string[] bias_names;"
        " geometry_msgs/Vector3[] force_bias; geometry_msgs/Wrench wrench_rmse;"
        " uint32 samples; string solver_status"
    ),
    "Event": "std_msgs/Header header; string label",
}


def test_there_is_no_other_message() -> None:
    assert {path.stem for path in FOLDER.glob("*.msg")} == set(CONTRACT)


@pytest.mark.parametrize("name", CONTRACT)
def test_a_message_is_the_contract_s(name: str) -> None:
    lines = [line.partition("#")[0].split() for line in (FOLDER / f"{name}.msg").open()]
    fields = [tuple(words) for words in lines if len(words) == 2 and "=" not in words[1]]
    assert fields == [tuple(field.split()) for field in CONTRACT[name].split(";")]
    assert list(getattr(msg, name).get_fields_and_field_types()) == [n for _, n in fields]
    offline = typestore().types[f"socket_testbed_msgs/msg/{name}"]
    assert [f for f in offline.__dataclass_fields__ if f.islower() and f != "__msgtype__"] == [
        n for _, n in fields
    ]


@pytest.mark.parametrize("name", CONTRACT)
def test_a_unit_stands_beside_every_field(name: str) -> None:
    for line in (FOLDER / f"{name}.msg").read_text().splitlines():
        if line and not line.startswith("#"):
            assert re.search(r"#.*\[[^\]]+\]", line), line
