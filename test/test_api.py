"""The public Python API: its examples run, and the command line gives the same."""

import doctest
import json
import os
from functools import partial
from pathlib import Path
from typing import Any

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
from socket_testbed.trials.trial import Trial

FUNCTIONS = [name for name in st.__all__ if name.islower()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the examples: two simulated trials, bench data, a scan and other sources."""
    path = tmp_path_factory.mktemp("api")
    st.simulate(path / "trials" / "hold", duration=40, seed=3)
    st.simulate(path / "trials" / "walk", "multi_direction", duration=40, seed=4)
    usual = packaged("config", "socket.yaml").read_text()
    (path / "moved.yaml").write_text(usual.replace("distal: distal}", "distal: h065_a356}"))
    write_bench(path / "bench.csv", sensor_bench(play=0.04))
    meshes.write_stl(meshes.open_cone(0.05, 0.058, 0.08, 0.01), path / "scan.stl")
    bench = make_bench(np.random.default_rng(23))
    write_take(bench.take, path / "take.csv")
    write_landmarks(bench.document, path / "landmarks.yaml")
    rows = [f"{0.01 * i:.2f},1,2,{-10.0 - 0.1 * i:.1f},0,0,0" for i in range(401)]
    titles = "time [s],Fx [N],Fy [N],Fz [N],Mx [N m],My [N m],Mz [N m]"
    (path / "load_cell.csv").write_text("\n".join([titles, *rows, ""]))
    (path / "old_socket.yaml").write_text(packaged("config", "socket.yaml").read_text())
    return path


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("write_report", "tile")]


@pytest.mark.usefixtures("few_variants", "own_laws")
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


@pytest.fixture(scope="module")
def workplace(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, st.TrialFit]:
    """A folder with links to the examples, and a model of the hold, there in `model.json`."""
    path = tmp_path_factory.mktemp("verbs")
    for example in (*folder.iterdir(), *(folder / "trials").iterdir()):
        (path / example.name).symlink_to(example)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        fitted = st.fit("hold", "20:35", variant="stiffness", leave_out=["Mz"])
        fitted.save("model.json")
    return path, fitted


ABOUT = (0.02, -0.01, 0.4)  # [m]
SAME = {  # by output: what the API writes, and the line of the verb
    "json": (
        lambda out, fitted: fitted.save(out),
        "fit hold --segment 20:35 --leave-out Mz --variant stiffness",
    ),
    "errors": (
        lambda out, fitted: st.evaluate("walk", fitted, "all", pressure=True).save(out),
        "evaluate walk --model model.json --segment all --pressure",
    ),
    "front.csv": (
        lambda out, _: st.pareto("hold", "20:35", thetas=3, smoothness=1e-4, leave_out=["Mz"]).save(
            out
        ),
        "pareto hold --segment 20:35 --leave-out Mz --thetas 3 --smoothness 1e-4",
    ),
    "csv": (
        lambda out, fitted: st.export(
            "hold", out, "20:35", fitted, force_map=True, pressure=True, about=ABOUT
        ),
        "export hold --segment 20:35 --model model.json --map --pressure --about 0.02 -0.01 0.4",
    ),
    "cycles.csv": (
        lambda out, _: st.export("hold", out, cycles="placed:removed"),
        "export hold --cycles placed:removed",
    ),
    "map.csv": (
        lambda out, _: st.force_map("hold", "20:35").save(out),
        "map hold --segment 20:35",
    ),
    "time.csv": (
        lambda out, _: st.pressure("hold", "20:35", share=0.01).save(out, over_time=True),
        "pressure hold --segment 20:35 --share 0.01 --over-time",
    ),
    "compared.csv": (
        lambda out, _: st.compare("hold", "walk", segment="15:17", threshold=20.0).save(out),
        "compare hold walk --segment 15:17 --threshold 20",
    ),
    "calibration": (
        lambda out, _: st.calibrate("bench.csv", "distal", wiring=(2, 3, 0, 1)).save(out),
        "calibrate bench.csv --cluster distal --wiring 2 3 0 1",
    ),
    "socket": (
        lambda out, _: st.register("take.csv", "landmarks.yaml", "old_socket.yaml", out),
        "register take.csv --landmarks landmarks.yaml --socket old_socket.yaml",
    ),
}


@pytest.mark.parametrize("output", SAME)
def test_a_verb_writes_the_api_s_bytes(output, workplace, monkeypatch, capsys) -> None:
    path, fitted = workplace
    monkeypatch.chdir(path)
    write, line = SAME[output]
    own, of_verb = Path(f"api.{output}"), Path(f"verb.{output}")
    write(str(own), fitted)
    assert run([*line.split(), "-o", str(of_verb)]) == 0
    assert own.read_bytes() == of_verb.read_bytes()


def test_a_tile_s_column_differs_from_its_region(folder) -> None:
    """Though both have the same name."""
    found = st.pressure(folder / "trials" / "hold", "20:35", share=0.01)
    of_region = found.over_time()["distal.shear [kPa]"]
    expected = found.outputs.series.shear.value[:, [p.name for p in found.places].index("distal")]
    np.testing.assert_allclose(of_region, 1e-3 * expected)


FEW_VARIANTS = ("stiffness", "stiffness_bias")  # the others repeat what these show


@pytest.fixture(scope="module")
def results(folder: Path) -> dict[str, Result]:
    """A result of every kind, by the name of its class."""
    moved = folder / "surveyed"
    few = folder / "few.yaml"
    few.write_text("estimator_node: {ros__parameters: {force_map: {draws: 4}}}\n")
    places = folder / "moved.yaml"
    st.simulate(moved, duration=40, seed=3, donning=1, geometry=places)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("socket_testbed.identification.validation.VARIANTS", FEW_VARIANTS)
        trial = st.open_trial(folder / "trials" / "hold", notify=lambda note: None)
        fitted = st.fit(trial, variant="stiffness")
        found = [
            fitted,
            st.evaluate(trial, fitted, pressure=True),
            st.pareto(trial, thetas=3),
            st.force_map(trial, "10:12"),
            st.pressure(trial, "10:12"),
            st.cycles(trial, "Fz", by="placed:removed"),
            st.validate(trial),
            st.compare(trial, folder / "trials" / "walk", segment="15:17"),
            st.survey(trial, moved, params=few),
            st.calibrate(folder / "bench.csv", "distal", wiring=(2, 3, 0, 1)),
            st.paper(trial, thetas=3, frames=40),
        ]
    return {type(result).__name__: result for result in found}


# Tests make kinds of their own.
OWN = "socket_testbed."
RESULTS = sorted(kind.__name__ for kind in Result.__subclasses__() if OWN in kind.__module__)


def test_there_is_a_result_of_every_kind(results) -> None:
    assert sorted(results) == RESULTS and len(results) == 11


@pytest.mark.parametrize("name", RESULTS)
def test_every_result_has_a_table(name: str, results, tmp_path) -> None:
    found = results[name]
    assert repr(found).startswith(f"{name}(") and len(found.to_dataframe())
    found.save(tmp_path / f"{name}.csv")
    written = (tmp_path / f"{name}.csv").read_text()
    assert len(written) > 100 and (written[0] == "{") is (name == "TrialFit")


@pytest.mark.parametrize("name", RESULTS)
def test_every_result_has_a_document(name: str, results, tmp_path) -> None:
    found = results[name]
    assert json.loads(found.to_json()) == found.document()
    if name not in ("TrialFit", "CalibratedCluster"):
        found.save(tmp_path / "found.json")
        assert json.loads((tmp_path / "found.json").read_text()) == found.document()


@pytest.mark.parametrize("name", [name for name in RESULTS if name != "PaperTable"])
def test_every_result_has_a_figure(name: str, results) -> None:
    figure = results[name].figure(88, title=False)
    assert figure.get_figwidth() * 25.4 == pytest.approx(88)


@pytest.fixture(scope="module")
def mapped(folder: Path):
    """The force map of some seconds."""
    return st.force_map(str(folder / "trials" / "walk"), "10:12")  # a path where a trial is taken


def test_a_map_has_an_instant(mapped, folder) -> None:
    at = mapped.at(11.1)
    row = int(np.flatnonzero(mapped.time <= 11.1)[-1])
    assert at.time == mapped.time[row] and len(at.estimate.forces) == 1
    assert st.pressure(folder / "trials" / "walk", at.segment).time == at.time
    assert np.allclose(at.estimate.normal_pressure[0], mapped.estimate.normal_pressure[row])
    geometry = mapped.trial.geometry
    local = at.draws(400)[0] * [1, 1, -1] * geometry.areas[:, None]
    total = np.einsum("nij,dnj->di", geometry.rotations, local)[:, 2]
    assert total.mean() == pytest.approx(at.estimate.forces[0, :, 2].sum(), rel=0.03)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda found: found, id="map"),
        pytest.param(lambda found: found.at(11.1), id="instant"),
        pytest.param(lambda found: st.cycles(found.trial, "Fz", by="placed:removed"), id="cycles"),
    ],
)
def test_a_notebook_draws_into_its_own_axes(mapped, make) -> None:
    make(mapped).draw(ax=(ax := Figure().subplots()))
    assert ax.has_data()


@pytest.mark.slow
def test_the_example_notebook_runs_twice(tmp_path: Path) -> None:
    path = CHECKOUT / "examples" / "first_trial.ipynb"
    for _ in range(2):
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, kernel_name="python3", timeout=300).execute(
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, cwd=str(tmp_path)
        )
    assert (tmp_path / "hold.html").is_file()


@pytest.mark.slow
def test_the_readme_s_lines_run_twice(tmp_path, monkeypatch, capsys) -> None:
    """They show a model that predicts every channel of the wrench, as the table says."""
    mpl.use("Agg")
    monkeypatch.chdir(tmp_path)
    begin = "import socket_testbed"
    program = (CHECKOUT / "README.md").read_text().partition(f"```python\n{begin}")[2]
    for _ in range(2):
        names: dict[str, Any] = {}
        exec(compile(begin + program.partition("```")[0], "README.md", "exec"), names)
    assert Path("push.png").stat().st_size > 5000
    assert "pressure sd [kPa]" in capsys.readouterr().out
    assert (names["found"].to_dataframe().skill[:6] > 0.9).all()


@pytest.fixture(scope="module")
def in_millimetres(folder: Path):
    """A trial whose poses are in mm, and a model of it as it was."""
    fitted = st.fit(folder / "trials" / "hold", "20:35")
    trial = st.open_trial(folder / "trials" / "hold")
    trial.samples().position[:] *= 1e3
    return trial, fitted


@pytest.mark.parametrize(
    "use",
    [
        pytest.param(lambda trial, _: st.fit(trial), id="fit"),
        pytest.param(st.predict, id="predict"),
        pytest.param(st.evaluate, id="evaluate"),
    ],
)
def test_poses_in_millimetres_are_refused(in_millimetres, use) -> None:
    """What else counts as wrong: identification/test_data_check.py."""
    with pytest.raises(st.TestbedError, match=r"limb position is .* likely in millimetres"):
        use(*in_millimetres)


def test_a_comparison_names_the_trial_in_millimetres(in_millimetres, folder) -> None:
    trial, _ = in_millimetres
    with pytest.raises(st.TestbedError, match=r"^hold: the limb position is .* likely in"):
        st.compare(folder / "trials" / "walk", trial, segment="15:20")


@pytest.fixture(scope="module")
def stored(folder: Path, tmp_path_factory: pytest.TempPathFactory):
    """A trial, a fit to its averaged poses, and the model that comes back from its file."""
    trial = st.open_trial(folder / "trials" / "hold")
    fitted = st.fit(trial, pose_smoothing=2.0, leave_out=["distal.Fy"])
    path = tmp_path_factory.mktemp("stored") / "model.json"
    fitted.save(path)
    return trial, fitted, st.read_model(path)


@pytest.mark.parametrize("name", ["settings", "samples", "last_stamp", "errors"])
def test_a_model_comes_back(stored, name: str) -> None:
    _, fitted, model = stored
    assert getattr(model, name) == getattr(fitted.fit, name)


def test_a_model_is_judged_on_averaged_poses(stored) -> None:
    """As in its fit."""
    trial, fitted, model = stored
    judged = st.evaluate(trial, model).to_dataframe()
    pd.testing.assert_frame_equal(judged, fitted.to_dataframe(), rtol=1e-9)
    raw = st.evaluate(trial, model, pose_smoothing=0.0)
    assert raw.to_dataframe().loc["Fz", "RMSE"] != judged.loc["Fz", "RMSE"]


def test_a_table_shows_the_model_s_prediction(stored, tmp_path) -> None:
    trial, _, model = stored
    shown = st.export(trial, tmp_path / "table.csv", model=model)["predicted.Fz [N]"]
    np.testing.assert_allclose(shown, st.predict(trial, model)["Fz [N]"])


# --- problems in the data


@pytest.fixture(scope="module")
def doubtful(folder: Path, tmp_path_factory: pytest.TempPathFactory):
    """A function that opens a hold of 28 kg by a person of 5 kg, and collects its notes."""
    path = tmp_path_factory.mktemp("doubtful")
    for name in ("hold", "again"):
        st.simulate(path / name, duration=40, seed=3, donning=1 if name == "again" else None)
        st.annotate(path / name, mass=5)
    moved = {"duration": 40, "seed": 3, "donning": 2, "geometry": folder / "moved.yaml"}
    st.simulate(path / "moved", **moved)

    def opened(name: str = "hold") -> tuple[Trial, list[str]]:
        notes: list[str] = []
        return st.open_trial(path / name, notify=notes.append), notes

    return opened


@pytest.fixture(scope="module")
def sound_model(folder: Path) -> st.TrialFit:
    return st.fit(folder / "trials" / "hold", variant="stiffness")


@pytest.mark.usefixtures("few_variants")
@pytest.mark.parametrize(
    "use",
    [
        pytest.param(lambda trial, *_: st.fit(trial, variant="stiffness"), id="fit"),
        pytest.param(lambda trial, model, *_: st.evaluate(trial, model), id="evaluate"),
        pytest.param(lambda trial, model, *_: st.predict(trial, model), id="predict"),
        pytest.param(lambda trial, *_: st.pressure(trial), id="pressure"),
        pytest.param(lambda trial, *_: st.force_map(trial), id="force_map"),
        pytest.param(lambda trial, *_: st.pareto(trial, thetas=3), id="pareto"),
        pytest.param(lambda trial, *_: st.paper(trial, thetas=3), id="paper"),
        pytest.param(lambda trial, *_: st.validate(trial), id="validate"),
        pytest.param(lambda trial, _, folder, other: st.compare(trial, other), id="compare"),
        pytest.param(
            lambda trial, _, folder, other: st.survey(trial, folder / "moved"), id="survey"
        ),
        pytest.param(
            lambda trial, _, folder, other: st.export(trial, folder / "out.csv"), id="export"
        ),
        pytest.param(
            lambda trial, _, folder, other: st.export(trial, folder / "out.mot"), id="export-mot"
        ),
        pytest.param(
            lambda trial, *_: st.cycles(trial, "Fz", by="placed:removed", segment="all"),
            id="cycles",
        ),
        pytest.param(lambda trial, *_: st.view(trial, port=0).close(), id="view"),
    ],
)
def test_a_problem_in_the_data_is_noted_once(use, doubtful, sound_model) -> None:
    """As the verbs do, whatever the function."""
    trial, notes = doubtful()
    use(trial, sound_model, trial.path.parent, doubtful("again")[0])
    assert len([note for note in notes if "5 kg" in note]) == 1
