"""The public Python API: its examples run, and the command line gives the same."""

import doctest
import json
import os
from functools import partial
from pathlib import Path

import matplotlib as mpl
import nbformat
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from nbclient import NotebookClient
from support import CHECKOUT, meshes
from support.benches import sensor_bench, write_bench
from support.takes import make_bench, write_landmarks, write_take

import socket_testbed as st
from socket_testbed.__main__ import run
from socket_testbed.api import Result
from socket_testbed.files import packaged
from socket_testbed.socket_design import tiling
from socket_testbed.socket_design.tiling import TilingSettings

FUNCTIONS = [name for name in st.__all__ if name.islower()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the examples: two simulated trials, bench data, a scan and a static take."""
    path = tmp_path_factory.mktemp("api")
    st.simulate(path / "trials" / "hold", duration=40, seed=3)
    st.simulate(path / "trials" / "walk", "multi_direction", duration=40, seed=4)
    write_bench(path / "bench.csv", sensor_bench(play=0.04))
    meshes.write_stl(meshes.open_cone(0.05, 0.058, 0.08, 0.01), path / "scan.stl")
    bench = make_bench(np.random.default_rng(23))
    write_take(bench.take, path / "take.csv")
    write_landmarks(bench.document, path / "landmarks.yaml")
    (path / "old_socket.yaml").write_text(packaged("config", "socket.yaml").read_text())
    return path


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("write_report", "tile")]


@pytest.mark.usefixtures("few_variants")
@pytest.mark.parametrize("name", [*sorted({*FUNCTIONS} - {"write_report", "tile"}), *SLOW])
def test_an_example_runs(name: str, folder: Path, monkeypatch) -> None:
    # 300 rounds of the search find two tiles more and take most of the example's time.
    monkeypatch.setattr(tiling, "TilingSettings", partial(TilingSettings, rounds=12))
    monkeypatch.chdir(folder)
    (test,) = doctest.DocTestFinder(recurse=False).find(getattr(st, name), name, globs={"st": st})
    assert test.examples, f"{name} has no example"
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.REPORT_NDIFF
    said: list[str] = []
    failed = doctest.DocTestRunner(optionflags=flags).run(test, out=said.append).failed
    assert failed == 0, "".join(said)


def test_the_verbs_write_the_same_bytes(folder, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for path in (*folder.iterdir(), *(folder / "trials").iterdir()):
        Path(path.name).symlink_to(path)
    fitted = st.fit("hold", "20:35", variant="stiffness", leave_out=["Mz"])
    fitted.save("api.json")
    st.evaluate("walk", fitted, "all", pressure=True).save("api.errors")
    st.pareto("hold", "20:35", thetas=3, smoothness=1e-4, leave_out=["Mz"]).save("api.front.csv")
    about = (0.02, -0.01, 0.4)
    st.export("hold", "api.csv", "20:35", fitted, force_map=True, pressure=True, about=about)
    st.export("hold", "api.cycles.csv", cycles="placed:removed")
    st.force_map("hold", "20:35").save("api.map.csv")
    found = st.pressure("hold", "20:35", share=0.01)
    found.save("api.time.csv", over_time=True)
    of_region = found.over_time()["distal.shear [kPa]"]  # a tile has the name, too
    expected = found.outputs.series.shear.value[:, [p.name for p in found.places].index("distal")]
    np.testing.assert_allclose(of_region, 1e-3 * expected)
    st.compare("hold", "walk", segment="15:17", threshold=20.0).save("api.compared.csv")
    st.calibrate("bench.csv", "distal", wiring=(2, 3, 0, 1)).save("api.calibration")
    st.register("take.csv", "landmarks.yaml", "old_socket.yaml", "api.socket")
    for line in (
        "fit hold -o verb.json --segment 20:35 --leave-out Mz --variant stiffness",
        "evaluate walk --model api.json --segment all --pressure -o verb.errors",
        "pareto hold --segment 20:35 --leave-out Mz --thetas 3 --smoothness 1e-4 -o verb.front.csv",
        "export hold --segment 20:35 --model api.json --map --pressure -o verb.csv"
        " --about 0.02 -0.01 0.4",
        "export hold --cycles placed:removed -o verb.cycles.csv",
        "map hold --segment 20:35 -o verb.map.csv",
        "pressure hold --segment 20:35 --share 0.01 --over-time -o verb.time.csv",
        "compare hold walk --segment 15:17 --threshold 20 -o verb.compared.csv",
        "calibrate bench.csv --cluster distal --wiring 2 3 0 1 -o verb.calibration",
        "register take.csv --landmarks landmarks.yaml --socket old_socket.yaml -o verb.socket",
    ):
        assert run(line.split()) == 0
    written = [path.name for path in tmp_path.glob("api.*")]
    assert len(written) == 10
    for name in written:
        assert Path(name).read_bytes() == Path(name.replace("api", "verb", 1)).read_bytes(), name


@pytest.mark.usefixtures("few_variants")
def test_every_result_has_a_table_a_document_files_and_a_figure(folder, tmp_path) -> None:
    trial = st.open_trial(folder / "trials" / "hold", notify=lambda note: None)
    fitted = st.fit(trial, variant="stiffness")
    results = [
        fitted,
        st.evaluate(trial, fitted, pressure=True),
        st.pareto(trial, thetas=3),
        st.force_map(trial, "10:12"),
        st.pressure(trial, "10:12"),
        st.cycles(trial, "Fz", by="placed:removed"),
        st.validate(trial),
        st.compare(trial, folder / "trials" / "walk", segment="15:17"),
        st.calibrate(folder / "bench.csv", "distal", wiring=(2, 3, 0, 1)),
        st.paper(trial, thetas=3, frames=40),
    ]
    assert {type(found) for found in results} == {*Result.__subclasses__()}
    for found in results:
        name = type(found).__name__
        assert repr(found).startswith(f"{name}(") and len(found.to_dataframe())
        assert json.loads(found.to_json()) == found.document()
        found.save(tmp_path / f"{name}.csv")
        written = (tmp_path / f"{name}.csv").read_text()
        assert len(written) > 100 and (written[0] == "{") is (name == "TrialFit")
        if name not in ("TrialFit", "CalibratedCluster"):
            found.save(tmp_path / "found.json")
            assert json.loads((tmp_path / "found.json").read_text()) == found.document()
        if name != "PaperTable":
            assert found.figure(88, title=False).get_figwidth() * 25.4 == pytest.approx(88)


def test_a_notebook_draws_maps_at_an_instant_and_into_its_own_axes(folder) -> None:
    path = folder / "trials" / "walk"
    found = st.force_map(str(path), "10:12")  # a path where a trial is taken
    at = found.at(11.1)
    row = int(np.flatnonzero(found.time <= 11.1)[-1])
    assert at.time == found.time[row] and len(at.estimate.forces) == 1
    assert st.pressure(path, at.segment).time == at.time
    assert np.allclose(at.estimate.normal_pressure[0], found.estimate.normal_pressure[row])
    geometry = found.trial.geometry
    local = at.draws(400)[0] * [1, 1, -1] * geometry.areas[:, None]
    total = np.einsum("nij,dnj->di", geometry.rotations, local)[:, 2]
    assert total.mean() == pytest.approx(at.estimate.forces[0, :, 2].sum(), rel=0.03)

    for result in (found, at, st.cycles(path, "Fz", by="placed:removed")):
        result.draw(ax=(ax := Figure().subplots()))
        assert ax.has_data()


@pytest.mark.slow
def test_the_example_notebook_runs(tmp_path: Path) -> None:
    path = CHECKOUT / "examples" / "first_trial.ipynb"
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, kernel_name="python3", timeout=300).execute(
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, cwd=str(tmp_path)
    )
    assert (tmp_path / "hold.html").is_file()


@pytest.mark.slow
def test_the_readme_s_lines_run(tmp_path, monkeypatch, capsys) -> None:
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    begin = "import socket_testbed"
    program = (CHECKOUT / "README.md").read_text().partition(f"```python\n{begin}")[2]
    exec(compile(begin + program.partition("```")[0], "README.md", "exec"), {})
    assert Path("push.png").stat().st_size > 5000
    assert "pressure sd [kPa]" in capsys.readouterr().out


def test_poses_in_millimetres_are_refused_wherever_they_are_used(folder) -> None:
    """What else counts as wrong: identification/test_data_check.py."""
    fitted = st.fit(folder / "trials" / "hold", "20:35")
    trial = st.open_trial(folder / "trials" / "hold")
    trial.samples().position[:] *= 1e3
    for use in (st.fit, lambda t: st.predict(t, fitted), lambda t: st.evaluate(t, fitted)):
        with pytest.raises(st.TestbedError, match=r"limb position is .* likely in millimetres"):
            use(trial)
    with pytest.raises(st.TestbedError, match=r"^hold: the limb position is .* likely in"):
        st.compare(folder / "trials" / "walk", trial, segment="15:20")


def test_a_model_comes_back_and_is_judged_on_poses_averaged_as_in_its_fit(folder, tmp_path) -> None:
    trial = st.open_trial(folder / "trials" / "hold")
    fitted = st.fit(trial, pose_smoothing=2.0, leave_out=["distal.Fy"])
    fitted.save(tmp_path / "model.json")
    stored = st.read_model(tmp_path / "model.json")
    for name in ("settings", "samples", "last_stamp", "errors"):
        assert getattr(stored, name) == getattr(fitted.fit, name)
    judged = st.evaluate(trial, stored).to_dataframe()
    pd.testing.assert_frame_equal(judged, fitted.to_dataframe(), rtol=1e-9)
    raw = st.evaluate(trial, stored, pose_smoothing=0.0)
    assert raw.to_dataframe().loc["Fz", "RMSE"] != judged.loc["Fz", "RMSE"]
    shown = st.export(trial, tmp_path / "table.csv", model=stored)["predicted.Fz [N]"]
    np.testing.assert_allclose(shown, st.predict(trial, stored)["Fz [N]"])
