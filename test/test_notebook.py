"""What a notebook does: wrong calls end in one line, results are copied, tabled and selected."""

import pickle
import shutil
import warnings
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from support import scene

import socket_testbed as st
from socket_testbed.errors import ConfigurationError, TrialError
from socket_testbed.errors import TestbedError as UserError
from socket_testbed.trials.segment import Segment


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("notebook")
    scene.write(path / "hold")
    scene.write(path / "walk")
    return path


@pytest.fixture(scope="module")
def trial(folder: Path):
    return st.open_trial(folder / "hold", notify=lambda note: None)


@pytest.fixture(scope="module")
def made(trial, folder: Path):
    """Results of every kind, made once, and the names that the wrong calls use."""
    return SimpleNamespace(
        st=st,
        np=np,
        pd=pd,
        Path=Path,
        Figure=Figure,
        trial=trial,
        hold=folder / "hold",
        walk=folder / "walk",
        out=folder / "out",
        nan=float("nan"),
        pressure=st.pressure(trial, "all"),
        map=st.force_map(trial, "all"),
    )


WRONG = {
    # a call, and the line in which it ends
    "st.open_trial(None)": "the trial is None: give a path",
    "st.open_trial(3)": "the trial is 3: give a path",
    "st.open_trial('')": "the trial is an empty text: give a path",
    "st.open_trial([hold, walk])": "the trial is a list of 2: give a path",
    "st.open_trial(hold, unloaded=5)": "unloaded is 5: give a span such as",
    "st.open_trial(hold, unloaded=[(0, nan)])": "a time of unloaded is nan: give a number",
    "st.open_trial(hold, unloaded=[(0, 1, 2)])": "unloaded is a list of 3: give a span",
    "st.open_trial(hold, unloaded=(5, 2))": "--unloaded is '5.0:2.0': give seconds as T0:T1",
    "st.open_trial(hold, tare=3)": "tare is 3: give a span such as",
    "st.open_trial(hold, tare=None)": "tare is None: give a span such as",
    "st.open_trial(hold, geometry=3)": "the file is 3: give a path",
    "st.open_trial(hold, notify='print')": "notify is 'print': give a function",
    "st.pressure(None)": "the trial is None: give one of st.open_trial",
    "st.pressure(trial.samples())": "the trial is of the kind Samples: give one of",
    "st.pressure(trial.to_dataframe())": "the trial is of the kind DataFrame: give one of",
    "st.pressure([hold, walk])": "the trial is a list of 2: give one of st.open_trial",
    "st.pressure(trial, 5)": "the segment is 5: give plateau",
    "st.pressure(trial, None)": "the segment is empty: give plateau",
    "st.pressure(trial, (20, 10))": "the segment is '20.0:10.0': give seconds as T0:T1",
    "st.pressure(trial, (nan, 10))": "the segment's time is nan: give a number",
    "st.pressure(trial, ('a', 'b'))": "the segment's time is 'a': give a number",
    "st.pressure(trial, (1, 2, 3))": "the segment is a list of 3: give plateau",
    "st.pressure(trial, slice(1, 2))": "the segment is slice(1, 2, None): give plateau",
    "st.pressure(trial, threshold=None)": "--threshold is empty: give a number from 0 to 500",
    "st.pressure(trial, threshold=501)": "--threshold is 501: give a number from 0 to 500",
    "st.pressure(trial, share=5.1)": "--share is 5.1: give a number from 0 to 5",
    "st.pressure(trial, regions='distal')": "regions is 'distal', not a mapping: give tiles",
    "st.pressure(trial, regions=['distal'])": "regions is a list of 1, not a mapping: give",
    "st.pressure(trial, leave_out=['distl'])": "leave_out: no channel 'distl': did you mean",
    "st.pressure(trial, leave_out=3)": "leave_out holds 3: give names of channels",
    "st.pressure(trial, params={})": "the file is of the kind dict: give a path",
    "st.fit(trial, theta=nan)": "theta is nan: give a number from 0 to 1",
    "st.pareto(trial, thetas=1)": "--thetas is 1: give a whole number from 2 to 10001",
    "st.pareto(trial, thetas=2.5)": "--thetas is 2.5: give a whole number",
    "st.evaluate(trial, None)": "the model is None: give a fit",
    "st.evaluate(trial, trial)": "the model is of the kind Trial: give a fit",
    "st.evaluate(trial, pressure)": "the model is of the kind TrialPressure: give a fit",
    "st.read_model(None)": "the file is None: give a path",
    "st.cycles(trial, 3)": "the quantity holds 3: give texts",
    "st.cycles(trial, [3])": "the quantity holds 3: give texts",
    "st.cycles(trial, 'Fz', by=None)": "the cycles' events are None: give a label",
    "st.cycles(trial, np.zeros(3))": "the quantity holds 0.0: give texts",
    "st.compare(hold, 3)": "the trial is 3: give one of st.open_trial",
    "st.compare(hold, None)": "the trial is None: give one of st.open_trial",
    "st.compare(pressure, pressure)": "the trial is of the kind TrialPressure: give one of",
    "st.compare(conditions=[[hold], [walk]])": "conditions is a list of 2, not a mapping: give",
    "st.validate(3)": "the trial is 3: give one of st.open_trial",
    "st.annotate(trial, remove=3)": "remove holds 3: give texts",
    "st.annotate(trial, remove='mas')": "remove is 'mas': did you mean 'mass'?",
    "st.simulate(None)": "the folder of the trial is None: give a path",
    "st.simulate(out, None)": "unknown scenario 'None': use one of",
    "st.simulate(out, seed=1.5)": "--seed is 1.5: give a whole number",
    "st.export(trial, None)": "the file is None: give a path",
    "st.export(trial, 'x.csv', about=3)": "about is 3: give three numbers",
    "st.export(trial, 'x.csv', about=('a', 'b', 'c'))": "about is ['a', 'b', 'c']: give three",
    "st.export(trial, 'x.csv', cycles=3)": "the cycles' events are 3: give a label",
    "st.write_report(trial, None)": "the page is None: give a path",
    "st.write_comparison(pressure, 'x.html')": "the comparison is of the kind TrialPressure: give",
    "pressure.draw()": "neither a file nor axes are given: give one of them",
    "pressure.draw(3)": "the file is 3: give a path",
    "pressure.draw(Figure().subplots())": "the file is a part of a figure: give axes as ax=...",
    "map.draws(1)": "count is 1: give a whole number of at least 2",
    "map.draws(2.5)": "count is 2.5: give a whole number",
    "pressure.draw(ax=3)": "ax is 3: give axes",
    "pressure.figure(width='wide')": "figures are not laid out for a width of wide mm: give 88",
    "pressure.save(None)": "the file is None: give a path",
    "pressure.save(None, over_time=True)": "the file is None: give a path",
    "map.at('x')": "the time is 'x': give a number",
    "map.at(None)": "the time is empty: give a number",
    "trial.select(3)": "the segment is 3: give plateau",
    "trial.select('platau')": "unknown segment 'platau': did you mean 'plateau'?",
    "trial.select('all', 3)": "the argument settings is 3: leave it",
    "trial.checked(3)": "leave_out holds 3: give names of channels",
    "st.view(trial, host=3)": "host is 3: give an address",
    "st.view(trial, model=3)": "the model is 3: give a fit",
    "st.calibrate(None, 'distal')": "bench is None: give a path",
    "st.calibrate([], 'distal')": "no bench data is given: name its CSV files",
    "st.calibrate('b.csv', 3)": "cluster holds 3: give texts",
    "st.calibrate('b.csv', 'distal', baseline=3)": "baseline is 3: give a path",
    "st.calibrate('b.csv', 'distal', geometry=3)": "the file is 3: give a path",
    "st.calibrate('b.csv', 'distal', wiring=3)": "--wiring is 3: give each of 0, 1, 2, 3 once",
    "st.calibrate('b.csv', 'distal', columns=['a'])": "columns is a list of 1, not a mapping: give",
    "st.tile(None)": "the file is None: give a path",
    "st.tile('s.stl', proximal=3)": "proximal is 3: give a text, such as '+z'",
    "st.tile('s.stl', points=[1, 2])": "points[0] is 1: give a list",
    "st.tile('s.stl', points=[[1, 2, 3]])": "points are not three of three numbers: pick three",
    "st.tile('s.stl', place='x')": "--place is 'x': give a whole number from 0 to",
    "st.tile('s.stl', keep_out=[3])": "keep_out holds 3: give texts",
    "st.register(None, None, None)": "the take is None: give a path",
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("call", WRONG)
def test_a_wrong_call_ends_in_one_line(call: str, made) -> None:
    with pytest.raises(UserError) as raised:
        eval(call, vars(made))
    assert str(raised.value).startswith(WRONG[call]) and "\n" not in str(raised.value)


RIGHT = {
    # other ways to say the same
    "trial.select((5, 10)).rows": slice(20, 41),
    "trial.select([5, 10]).rows": slice(20, 41),
    "trial.select(np.array([5, 10])).rows": slice(20, 41),
    "trial.select('5:10').rows": slice(20, 41),
    "trial.select(trial.select('5:10')).rows": slice(20, 41),
    "st.pressure(trial, (5, 10)).segment.rows": slice(20, 41),
    "st.force_map(trial, (5, 10)).segment.rows": slice(20, 41),
    "st.open_trial(hold, unloaded=(0, 1)).unloaded": ((0.0, 1.0),),
    "st.open_trial(hold, unloaded='0:1').unloaded": ((0.0, 1.0),),
    "st.open_trial(hold, unloaded=['0:1', (22, 23)]).unloaded": ((0.0, 1.0), (22.0, 23.0)),
    "st.open_trial(hold, tare=(0, 1)).tare": "0.0:1.0",
    "len(st.compare([hold, walk], segment=(5, 10)).items)": 2,
    "st.compare(conditions={1: hold, 2: [walk]}, segment=(5, 10)).items": ("1", "2"),
    "trial.channels(['distal', 'Mz'])": ("distal.Fx", "distal.Fy", "distal.Fz", "Mz"),
    "trial.channels('distal')": ("distal.Fx", "distal.Fy", "distal.Fz"),
    "trial.channels(['distal.Fz', 'distal'])": ("distal.Fz", "distal.Fx", "distal.Fy"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("call", RIGHT)
def test_a_call_is_understood(call: str, made) -> None:
    assert eval(call, vars(made)) == RIGHT[call]


@pytest.mark.parametrize(
    "foreign",
    [
        Segment("span", 0.0, 900.0, slice(0, 3600)),
        Segment("span", 3.0, 5.0, slice(0, 9)),
        Segment("span", 0.0, 5.0, slice(0, 9)),
    ],
    ids=["longer", "at other times", "of another rate"],
)
def test_a_foreign_segment_is_refused(foreign: Segment, trial) -> None:
    with pytest.raises(TrialError, match="is no part of the trial"):
        trial.select(foreign)


@pytest.mark.parametrize(
    "given",
    ["distal", ["distal"], ["distal.Fx", "distal.Fy", "distal.Fz"]],
    ids=["text", "list", "channels"],
)
def test_a_left_out_cluster_is_not_used(given: str | list[str], trial) -> None:
    used = st.pressure(trial, "all", leave_out=given).outputs.samples
    number = used.clusters.index("distal")
    assert np.isnan(used.local_forces[:, number]).all()
    assert np.isfinite(np.delete(used.local_forces, number, axis=1)).any()


def test_stored_settings_may_name_a_cluster(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "hold", tmp_path / "hold")
    text = "estimator_node:\n  ros__parameters:\n    identification.leave_out: [distal]\n"
    (tmp_path / "hold" / "testbed.yaml").write_text(text)
    own = st.open_trial(tmp_path / "hold")
    assert own.estimator.identification.leave_out == ("distal.Fx", "distal.Fy", "distal.Fz")


def test_a_selection_heeds_the_trial_s_limits(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "hold", tmp_path / "hold")
    text = "estimator_node:\n  ros__parameters:\n    plateau.least_duration: 500.0\n"
    (tmp_path / "hold" / "testbed.yaml").write_text(text)
    with pytest.raises(TrialError, match="no plateau of 500 s or more"):
        st.open_trial(tmp_path / "hold").select()


# --- copies


def copied(value):
    return pickle.loads(pickle.dumps(value))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    path = tmp_path_factory.mktemp("simulated")
    return st.simulate(path / "push", "ramp", duration=64, seed=1)


@pytest.fixture(scope="module")
def results(simulated, tmp_path_factory):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = st.fit(simulated, "all")
        other = tmp_path_factory.mktemp("other") / "other"
        shutil.copytree(simulated.path, other)
        return {
            "trial": simulated,
            "fit": fitted,
            "evaluation": st.evaluate(simulated, fitted, "all", pressure=True),
            "model": fitted.fit,
            "map": st.force_map(simulated, "all"),
            "pressure": st.pressure(simulated, "all"),
            "tradeoff": st.pareto(simulated, "all", thetas=3),
            "paper": st.paper(simulated, "all", thetas=3, frames=100),
            "cycles": st.cycles(simulated, ["Fz", "distal.Fx"]),
            "validation": st.validate(simulated),
            "comparison": st.compare(simulated, other, segment="all"),
            "truth": simulated.truth(),
            "segment": simulated.select("all"),
            "samples": simulated.samples(),
        }


KINDS = (
    *("trial", "fit", "evaluation", "model", "map", "pressure", "tradeoff", "paper", "cycles"),
    *("validation", "comparison", "truth", "segment", "samples"),
)


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_is_pickled(kind: str, results) -> None:
    found, copy = results[kind], copied(results[kind])
    assert type(copy) is type(found)
    if hasattr(found, "to_dataframe"):
        pd.testing.assert_frame_equal(copy.to_dataframe(), found.to_dataframe())
    if kind == "map":
        assert np.array_equal(copy.at(12.0).draws(4), found.at(12.0).draws(4))


def test_a_copy_does_not_repeat_notes(folder: Path) -> None:
    said: list[str] = []
    opened = st.open_trial(folder / "hold", notify=lambda note: said.extend([note]))
    opened.note("first")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        copy = copied(opened)
        copy.note("first")
        copy.note("second")
    assert said == ["first"] and [str(each.message) for each in warned] == ["second"]


@pytest.mark.slow
def test_processes_return_results(folder: Path) -> None:
    paths = [str(folder / name) for name in ("hold", "walk")]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(st.pressure, paths, ["all", "all"]))
    assert [each.trial.name for each in found] == ["hold", "walk"]


# --- long tables


def test_a_trial_has_a_long_table(trial) -> None:
    long = trial.to_long()
    assert [*long] == ["trial", "time [s]", "source", "quantity", "unit", "value"]
    wide = trial.to_dataframe()
    assert len(long) == wide.size and {*long["trial"]} == {"hold"}


@pytest.mark.parametrize(
    ("source", "quantity", "unit", "title"),
    [
        ("wrench", "Mx", "N m", "Mx [N m]"),
        ("limb", "q_z", "m", "q_z [m]"),
        ("distal", "Fy", "N", "distal.Fy [N]"),
    ],
    ids=["wrench", "limb", "cluster"],
)
def test_a_long_table_has_the_wide_one_s_values(
    source: str, quantity: str, unit: str, title: str, trial
) -> None:
    long, wide = trial.to_long(), trial.to_dataframe()
    own = long[(long["source"] == source) & (long["quantity"] == quantity)]
    np.testing.assert_array_equal(own["value"], wide[title])
    np.testing.assert_array_equal(own["time [s]"], wide.index)
    assert {*own["unit"]} == {unit}


def test_pressure_has_a_long_table(results) -> None:
    found = results["pressure"]
    long = found.to_long()
    own = long.query("part == 'regions' and name == 'socket' and quantity == 'peak pressure'")
    (row,) = own.to_dict("records")
    wide = found.regions.loc["socket"]
    assert row["unit"] == "kPa" and row["trial"] == "push"
    assert [row["value"], row["low"], row["high"]] == [
        wide[f"peak pressure{end} [kPa]"] for end in ("", " low", " high")
    ]
    over = found.to_long(over_time=True)
    series = found.over_time()
    own = over.query("part == 'tiles' and name == 'distal' and quantity == 'shear'")
    np.testing.assert_array_equal(own["high"], series["tile distal.shear high [kPa]"])
    own = over.query("part == 'regions' and name == 'distal' and quantity == 'mean pressure'")
    np.testing.assert_array_equal(own["low"], series["distal.mean pressure low [kPa]"])
    np.testing.assert_array_equal(own["time [s]"], series.index)


def test_a_map_has_a_long_table(results) -> None:
    long, wide = results["map"].to_long(), results["map"].to_dataframe()
    own = long.query("tile == 'distal' and quantity == 'pressure'")
    np.testing.assert_array_equal(own["value"], wide["distal.pressure [Pa]"])
    np.testing.assert_array_equal(own["sd"], wide["distal.pressure.sd [Pa]"])


def test_cycles_have_a_long_table(results) -> None:
    found = results["cycles"]
    long = found.to_long()
    own = long[(long["quantity"] == "distal.Fx") & (long["cycle"] == len(found))]
    np.testing.assert_array_equal(own["value"], found.curves[-1, :, 1])
    assert own["cycle [%]"].tolist() == [*range(101)] and {*own["unit"]} == {"N"}


# --- the truth


def test_a_simulated_trial_has_its_truth(simulated) -> None:
    truth, samples = simulated.truth(), simulated.samples()
    assert truth.tiles == simulated.geometry.names
    assert truth.forces.shape == (len(samples), len(truth.tiles), 3)
    assert np.abs(samples.wrench[:, 3:] - truth.wrench[:, 3:]).max() < 5.0


def test_a_recorded_trial_has_no_truth(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "hold", tmp_path / "hold")
    (tmp_path / "hold" / "ground_truth.npz").unlink()
    with pytest.raises(TrialError, match=r"holds no ground truth \(ground_truth.npz\): only"):
        st.open_trial(tmp_path / "hold").truth()


# --- many trials


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_more_than_twelve_trials_are_compared(folder: Path, tmp_path: Path) -> None:
    for number in range(14):
        shutil.copytree(folder / "hold", tmp_path / f"t{number}")
    found = st.compare(*sorted(tmp_path.iterdir()), segment=(5, 10))
    assert (
        len(found.items) == 14
        and found.tile_pressures(("value", "low", "high")).value.shape[0] == 14
    )
    found.draw(tmp_path / "maps.png")
    st.write_comparison(found, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 1e5


def test_unknown_parts_of_a_comparison_are_named(results) -> None:
    found = results["comparison"]
    with pytest.raises(ConfigurationError, match=r"no part 'region': did you mean 'regions'\?"):
        found.cells("region")
    with pytest.raises(ConfigurationError, match="no quantity 'peak'"):
        found.cells("regions", "peak")
