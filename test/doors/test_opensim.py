"""The files for OpenSim, read by OpenSim itself, against hand values of the scene with holes.

At 12.0 s the force is (14, 3, -90) N and the moment (0.55, 0.1, 0.5) N m, see `test_exports`; at
20.0 s, after the holes of `test_incomplete_exports`, the factor is 1 - cos(300 degrees) / 2 = 0.75,
and the force along z -60 N x 0.75 = -45 N.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import holes

import socket_testbed as st

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def opensim() -> Any:
    """OpenSim, which reports errors alone."""
    why = "the wheel of OpenSim is not installed: pip install -r requirements/opensim.txt"
    before = dict(os.environ)
    module = pytest.importorskip("opensim", reason=why)
    # Its import overwrites LD_LIBRARY_PATH, without which no later test's node finds ROS.
    os.environ.clear()
    os.environ.update(before)
    module.Logger.setLevelString("Error")
    return module


@pytest.fixture(scope="module")
def holed(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return holes.with_holes(scene_folder, tmp_path_factory.mktemp("holed") / "holed")


@pytest.fixture(scope="module", params=[".mot", ".sto"])
def loads(
    request: pytest.FixtureRequest, holed: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The wrenches of all samples, as OpenSim's loads."""
    path = tmp_path_factory.mktemp("loads") / f"loads{request.param}"
    st.export(holed, path)
    return path


def test_a_table_holds_all_measured_loads(loads: Path, opensim: Any) -> None:
    table = opensim.TimeSeriesTable(str(loads))
    assert table.getNumRows() == 89 and table.getNumColumns() == 9
    times = list(table.getIndependentColumn())
    assert times[0] == 0.25 and times[-1] == 23.75
    column = table.getDependentColumn("socket_force_vz").to_numpy()
    assert column[times.index(12.0)] == -90.0 and column[times.index(20.0)] == -45.0
    moment = [
        table.getDependentColumn(f"socket_torque_{axis}").to_numpy()[times.index(12.0)]
        for axis in "xyz"
    ]
    assert moment == pytest.approx([0.55, 0.1, 0.5], abs=1e-6)


def test_a_storage_is_read_to_its_end(loads: Path, opensim: Any) -> None:
    """OpenSim's tools read it so; a missing value would end it there."""
    storage = opensim.Storage(str(loads))
    assert storage.getSize() == 89
    assert (storage.getFirstTime(), storage.getLastTime()) == (0.25, 23.75)


def test_external_loads_act_after_the_holes(loads: Path, tmp_path: Path, opensim: Any) -> None:
    """On a body that carries the load cell, in its frame."""
    model = opensim.Model()
    body = opensim.Body("socket", 1.0, opensim.Vec3(0), opensim.Inertia(1, 1, 1))
    model.addBody(body)
    model.addJoint(opensim.FreeJoint("free", model.getGround(), body))
    force = opensim.ExternalForce()
    force.setName("limb")
    force.set_applied_to_body("socket")
    force.set_force_expressed_in_body("socket")
    force.set_point_expressed_in_body("socket")
    force.set_force_identifier("socket_force_v")
    force.set_point_identifier("socket_force_p")
    force.set_torque_identifier("socket_torque_")
    force.set_data_source_name(str(loads))
    external = opensim.ExternalLoads()
    external.setDataFileName(str(loads))
    external.cloneAndAppend(force)
    external.printToXML(str(tmp_path / "loads.xml"))
    model.addModelComponent(opensim.ExternalLoads(str(tmp_path / "loads.xml"), True))
    model.initSystem()
    (acting,) = (
        opensim.ExternalForce.safeDownCast(component)
        for component in model.getComponentsList()
        if component.getConcreteClassName() == "ExternalForce"
    )
    at_twelve = acting.getForceAtTime(12.0), acting.getTorqueAtTime(12.0)
    numbers = [vector.get(axis) for vector in at_twelve for axis in range(3)]
    assert numbers == pytest.approx([14.0, 3.0, -90.0, 0.55, 0.1, 0.5], abs=1e-5)
    assert acting.getForceAtTime(20.0).get(2) == pytest.approx(-45.0, abs=1e-5)


# --- markers


@pytest.fixture(scope="module")
def markers(holed: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("markers") / "markers.trc"
    st.export(holed, path)
    return str(path)


UNSEEN = (0, 50, 51, 52, 95)


def test_hidden_markers_leave_the_table_whole(markers: str, opensim: Any) -> None:
    table = opensim.TimeSeriesTableVec3(markers)
    assert table.getNumRows() == 96
    assert list(table.getColumnLabels())[::5] == ["socket_1", "pylon_3"]
    row = table.getRowAtIndex(48)
    first = [row.getElt(0, 0).get(axis) for axis in range(3)]
    assert first == pytest.approx([1000.0, 2000.0, 500.0], abs=1e-3)
    column = [table.getRowAtIndex(frame).getElt(0, 5).get(0) for frame in range(96)]
    assert tuple(frame for frame, x in enumerate(column) if np.isnan(x)) == UNSEEN
    assert list(table.getIndependentColumn())[48] == 12.0


def test_hidden_markers_leave_the_marker_data_whole(markers: str, opensim: Any) -> None:
    """As OpenSim's scaling and inverse kinematics read them."""
    data = opensim.MarkerData(markers)
    assert data.getNumFrames() == 96 and data.getNumMarkers() == 6
    assert data.getUnits().getAbbreviation() == "mm"
    second = data.getFrame(48).getMarker(1)
    expected = [1032.6122, 2083.8835, 510.0]
    assert [second.get(axis) for axis in range(3)] == pytest.approx(expected, abs=1e-3)
