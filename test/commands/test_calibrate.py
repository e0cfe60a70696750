"""The verb `calibrate`, from bench files to a calibration that the testbed reads."""

import dataclasses
import shutil

import numpy as np
import pytest
import yaml
from support import verbs
from support.benches import (
    ERRORS,
    FULL_SCALE,
    HEADER,
    bench_of,
    load_path,
    nominal,
    sensor_bench,
    write_bench,
)

from socket_testbed.__main__ import run
from socket_testbed.calibration.model import Calibration, read_calibration, write_calibration
from socket_testbed.errors import TestbedError
from socket_testbed.files import packaged
from socket_testbed.samples import Status
from socket_testbed.simulation.sensors import ClusterSensor, invert_calibration

WIRING = ("--wiring", 2, 3, 0, 1)  # of the package's own 'distal', whose sensor is simulated


@pytest.fixture
def call(capsys, tmp_path):
    """Call the verb on cluster `distal`; gives what it printed."""

    def called(*words) -> str:
        options = ("-o", tmp_path / "calibration.yaml", "--cluster", "distal")
        code, out, err = verbs.call(capsys, "calibrate", *words, *options)
        assert code == 0, err
        return out

    return called


@pytest.fixture
def refused(capsys, tmp_path):
    """Call the verb, which refuses; gives the one line."""

    def called(*words, named=()) -> str:
        options = ("-o", tmp_path / "calibration.yaml", "--cluster", "distal")
        return verbs.refused(capsys, "calibrate", *words, *options, named=named)

    return called


@pytest.fixture
def bench_file(tmp_path):
    return write_bench(tmp_path / "bench.csv", sensor_bench(play=0.04))


@pytest.fixture
def output(tmp_path):
    return tmp_path / "calibration.yaml"


def record(path) -> dict:
    return yaml.safe_load(path.read_text())["clusters"]["distal"]["bench"]


@pytest.mark.parametrize("seed", range(3))
def test_fresh_stresses_are_as_good_as_the_file_says(call, tmp_path, output, seed):
    call(write_bench(tmp_path / "bench.csv", sensor_bench(seed, play=0.04)), *WIRING)
    cluster = read_calibration(output).clusters["distal"]
    fresh = sensor_bench(seed, play=0.04, draw=1)
    stress, status = cluster.apply(fresh.capacitance, np.zeros((len(fresh), 4), dtype=np.uint8))
    assert (status == Status.OK).mean() > 0.9
    rmse = np.sqrt(np.mean((stress - fresh.stress) ** 2, axis=0))
    said = record(output)["held_out"]
    assert (rmse < 1.02 * np.array([said[n]["rmse"] for n in said])).all()
    assert list(said) == ["normal", "shear_x", "shear_y"]
    percent = [said[name]["percent"] for name in said]
    np.testing.assert_allclose(percent, 100.0 * rmse / FULL_SCALE, rtol=0.25)


def test_the_report_names_all_that_is_to_be_known(call, bench_file):
    out = call(bench_file, *WIRING)
    for words in ("18 cycles held out in turn", "+- (95 %)", "Pa/pF^2", "held-out RMSE Pa"):
        assert words in out
    for words in ("hysteresis % FS", "repeatability % FS", "calibrated range", "no outliers"):
        assert words in out
    assert "distal added in" in out


@pytest.mark.parametrize("coupling", [0.0, 0.03, 0.06])
def test_cross_talk_is_the_coupling_of_the_sensor(call, tmp_path, output, coupling):
    """Full shear x feels like so much of the full normal stress, and the other way round."""
    ramp = np.concatenate([np.linspace(0.0, 1.0, 15), np.linspace(1.0, 0.0, 15)])
    pure = [np.outer(ramp, [0.0, side * FULL_SCALE[1], 0.0]) for side in (1.0, -1.0) * 2]
    applied = np.concatenate([load_path(), *pure])
    felt = applied / FULL_SCALE
    felt[:, :2] += coupling * felt[:, 1::-1]
    bench = bench_of(invert_calibration(nominal(), felt * FULL_SCALE), applied)
    out = call(write_bench(tmp_path / "bench.csv", bench), *WIRING, "--force")
    found = record(output)["cross_talk_percent"]
    assert found["normal"] == pytest.approx(100.0 * coupling, rel=0.1, abs=0.1)
    # Normal stress has one sign: the fit's constant takes its mean, about a third, off the shear.
    assert 50.0 * coupling <= found["shear_x"] <= 100.0 * coupling + 0.1
    assert found["shear_y"] < 0.3
    assert "cross-talk % FS" in out and "no pure" not in out


def test_a_bench_without_pure_shear_says_so_instead_of_a_number(call, bench_file, output):
    out = call(bench_file, *WIRING)
    found = record(output)["cross_talk_percent"]
    assert found["normal"] is None and "no pure shear" in out
    assert 0.0 < found["shear_x"] < 3.0 and "no pure normal" not in out


def test_the_record_says_where_the_coefficients_come_from(call, bench_file, output):
    call(bench_file, *WIRING)
    stored = record(output)
    assert stored["source"] == "bench.csv" and stored["readings"] == 1062
    assert stored["forced"] is False and stored["limit_percent"] == 10.0
    assert stored["held_out_by"] == "18 cycles"
    assert stored["stress_range"]["normal"] == [0.0, 60000.0]
    assert 3.5 < stored["hysteresis_percent"]["normal"] < 4.5
    calibration = read_calibration(output)
    assert calibration.source == "distal: bench.csv" and calibration.date == stored["date"]
    assert calibration.clusters["distal"].bench == stored


def test_one_cluster_is_replaced_and_the_others_stay(call, bench_file, output):
    shutil.copyfile(packaged("config", "calibration.yaml"), output)
    old = read_calibration(output)
    out = call(bench_file)
    assert "distal replaced" in out and "kept: brim_lateral, mid_anterior" in out
    new = read_calibration(output)
    assert list(new.clusters) == list(old.clusters)
    assert (new.date, new.source) == (old.date, old.source)
    for name, cluster in old.clusters.items():
        same = new.clusters[name].to_document() == cluster.to_document()
        assert same == (name != "distal")
    np.testing.assert_array_equal(new.clusters["distal"].wiring, nominal().wiring)


def test_into_leaves_the_existing_file_alone(call, refused, bench_file, tmp_path, output):
    existing = tmp_path / "existing.yaml"
    brim = {"brim": nominal("brim_lateral")}
    write_calibration(Calibration(brim, "2026-01-02", "by hand"), existing)
    before = existing.read_bytes()
    call(bench_file, "--into", existing, *WIRING)
    assert existing.read_bytes() == before
    assert list(read_calibration(output).clusters) == ["brim", "distal"]
    assert "exists already" in refused(bench_file, "--into", existing, *WIRING)


def test_repeats_are_joined_and_held_out_file_by_file(call, tmp_path, output):
    files = [
        write_bench(tmp_path / f"run{k}.csv", sensor_bench(draw=k, play=0.04)) for k in range(3)
    ]
    out = call(*files, *WIRING)
    assert "3 files held out in turn" in out
    assert record(output)["source"] == "run0.csv, run1.csv, run2.csv"


def test_a_bad_fit_is_refused_with_its_numbers_unless_forced(call, refused, tmp_path, output):
    path = write_bench(tmp_path / "bench.csv", sensor_bench(play=0.3))
    line = refused(path, *WIRING)
    assert "exceeds 10 %" in line and "normal 1" in line and "--force" in line
    assert not output.exists()
    call(path, *WIRING, "--force")
    stored = record(output)
    assert stored["forced"] is True and stored["held_out"]["normal"]["percent"] > 10.0
    call(path, *WIRING, "--limit", 30)
    assert record(output)["forced"] is False and record(output)["limit_percent"] == 30.0


def test_outliers_are_shown_and_dropped_only_when_told(call, refused, tmp_path, output):
    bench = sensor_bench(play=0.04)
    bench.stress[[200, 500], 1] += 60e3
    path = write_bench(tmp_path / "bench.csv", bench)
    out = call(path, *WIRING, "--force")
    assert "2 outliers, kept in the fit" in out and "bench.csv line 202" in out
    assert record(output)["readings"] == 1062 and not record(output)["outliers_dropped"]
    out = call(path, *WIRING, "--drop-outliers")
    assert "2 outliers, left out of the fit" in out
    stored = record(output)
    assert stored["outliers"] == ["bench.csv line 202", "bench.csv line 502"]
    assert stored["outliers_dropped"] and stored["readings"] == 1060


def unloaded(path, capacitance):
    rows = [",".join(f"{value:.9g}" for value in capacitance)] * 5
    path.write_text("\n".join([",".join(HEADER[4:]), *rows]))
    return path


def test_baselines_are_stored_and_take_the_drift_off(call, tmp_path, output):
    bench = sensor_bench()
    rest, drift = bench.capacitance[0], np.array([0.2, 0.1, 0.15, 0.05])
    part = (bench.time / bench.time[-1])[:, None]
    drifted = dataclasses.replace(bench, capacitance=bench.capacitance + part * drift)
    clean_file = write_bench(tmp_path / "clean.csv", bench)
    path = write_bench(tmp_path / "bench.csv", drifted)
    before = unloaded(tmp_path / "before.csv", rest)
    after = unloaded(tmp_path / "after.csv", rest + drift)

    out = call(path, *WIRING, "--baseline", before, after)
    assert "drift, corrected" in out and "above the limit" in out
    corrected = read_calibration(output).clusters["distal"]
    np.testing.assert_allclose(corrected.baseline, rest, rtol=1e-8)
    assert corrected.bench["drift"]["flagged"] is True
    np.testing.assert_allclose(corrected.bench["drift"]["capacitance"], drift, rtol=1e-3)
    call(clean_file, *WIRING, "--baseline", before)
    clean = read_calibration(output).clusters["distal"]
    assert "drift" not in clean.bench and clean.baseline is not None
    np.testing.assert_allclose(corrected.normal, clean.normal, rtol=1e-6)


def test_forces_need_the_area_of_the_tile(call, refused, tmp_path, output):
    bench = sensor_bench()
    header = ("time [s]", "normal [N]", "shear_x [N]", "shear_y [N]", *HEADER[4:])
    newtons = dataclasses.replace(bench, stress=bench.stress * 9e-4 * 1e3)
    path = write_bench(tmp_path / "bench.csv", newtons, header)
    assert "--area" in refused(path, *WIRING)
    gains = []
    for area in (("--area", 9e-4), ("--geometry", packaged("config", "socket.yaml"))):
        call(path, *WIRING, *area)
        gains.append(read_calibration(output).clusters["distal"].normal[1])
        output.unlink()
    call(write_bench(path, bench), *WIRING)
    gains.append(read_calibration(output).clusters["distal"].normal[1])
    np.testing.assert_allclose(gains, gains[0], rtol=1e-6)


@pytest.mark.parametrize("suffix", ["png", "pdf"])
def test_a_figure_is_drawn_even_of_a_fit_that_is_refused(refused, tmp_path, suffix):
    bench = sensor_bench(play=0.3)
    bench.stress[300, 2] = 90e3
    path = write_bench(tmp_path / "bench.csv", bench)
    figure = tmp_path / f"fit.{suffix}"
    refused(path, *WIRING, "--figure", figure)
    start = {"png": b"\x89PNG", "pdf": b"%PDF"}[suffix]
    assert figure.read_bytes().startswith(start) and figure.stat().st_size > 5000


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ((), ("wiring 0 1 2 3", "--wiring 2 3 0 1")),
        (("--wiring", 0, 0, 1, 2), ("--wiring is [0, 0, 1, 2]", "once")),
        (("--wiring", 2, 3, 1, 0), ("exceeds 10 %", "shear_x 4")),
        ((*WIRING, "--units", "normal"), ("--units: 'normal' is no", "normal=kPa")),
        ((*WIRING, "--units", "normel=kPa"), ("no quantity 'normel'", "normal")),
        ((*WIRING, "--units", "c0=pF", "c0=fF"), ("c0 is given twice", "once")),
        ((*WIRING, "--units", "normal=Pa"), ("normal spans only 60 Pa", "--units normal=UNIT")),
        ((*WIRING, "--columns", "normal=load"), ("no column for normal", "")),
        ((*WIRING, "--limit", -1), ("--limit", "from 0 to 100")),
        ((*WIRING, "--area", 900), ("--area is 900", "from 1e-06 to 0.05")),
        ((*WIRING, "--figure", "fit.txt"), ("fit.txt", ".png or .pdf")),
        ((*WIRING, "--baseline", "a", "b", "c"), ("--baseline: 3 files", "before")),
        ((*WIRING, "--baseline", "none.csv"), ("none.csv", "no such file")),
        ((*WIRING, "--into", "none.yaml"), ("none.yaml", "no such file")),
    ],
)
def test_a_wrong_call_gives_one_line(refused, bench_file, output, words, parts):
    line = refused(bench_file, *words)
    for part in parts:
        assert part in line
    assert not output.exists()


def test_an_unknown_cluster_of_a_geometry_is_named(refused, bench_file, tmp_path):
    socket = tmp_path / "socket.yaml"
    text = packaged("config", "socket.yaml").read_text()
    socket.write_text(text.replace("  distal: distal", "  tip: distal"))
    assert "has no cluster 'distal'" in refused(bench_file, *WIRING, "--geometry", socket)


def test_a_gain_of_the_wrong_sign_is_refused_even_by_force(refused, tmp_path, output):
    bench = sensor_bench()
    upside_down = bench_of(12.0 - bench.capacitance, bench.stress)
    path = write_bench(tmp_path / "bench.csv", upside_down)
    line = refused(path, "--wiring", 0, 1, 2, 3, "--force")
    assert "gain of the normal stress" in line and "compression" in line
    assert not output.exists()


def test_a_calibration_without_a_record_is_read_and_written_as_before(tmp_path):
    old = read_calibration(packaged("config", "calibration.yaml"))
    assert all(c.baseline is None and not c.bench for c in old.clusters.values())
    write_calibration(old, tmp_path / "copy.yaml")
    assert set(yaml.safe_load((tmp_path / "copy.yaml").read_text())["clusters"]["distal"]) == {
        *("normal", "shear_x", "shear_y", "mean_range", "difference_range", "wiring")
    }


def test_a_wrong_baseline_or_record_is_named(call, bench_file, output, tmp_path):
    call(bench_file, *WIRING)
    document = yaml.safe_load(output.read_text())
    for key, value in (("baseline", [1.0, 2.0]), ("bench", [1])):
        document["clusters"]["distal"][key] = value
        (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(document))
        with pytest.raises(TestbedError, match=rf"wrong.yaml: clusters: distal: {key}"):
            read_calibration(tmp_path / "wrong.yaml")
        document["clusters"]["distal"].pop(key)


def test_no_wiring_is_read_from_a_bench_without_shear(call, refused, tmp_path):
    """The bench's own load cell shows a noise of 60 Pa, which no channel follows."""
    rng = np.random.default_rng(1)
    for missing, name in ((1, "shear_x"), (2, "shear_y")):
        stress = load_path()
        stress[:, missing] = 0.0
        sensor = ClusterSensor(nominal(), ERRORS, np.random.default_rng(0))
        capacitance = sensor.respond(stress, np.zeros(len(stress)))
        capacitance = capacitance + rng.normal(0.0, ERRORS.capacitance_noise, capacitance.shape)
        stress[:, missing] = rng.normal(0.0, 60.0, len(stress))
        error = refused(write_bench(tmp_path / "bench.csv", bench_of(capacitance, stress)))
        assert f"no input follows {name}" in error and "--wiring" not in error


def test_the_same_bench_file_for_another_cluster_is_noted(bench_file, tmp_path, capsys):
    output = tmp_path / "calibration.yaml"
    words = [str(word) for word in ("calibrate", bench_file, *WIRING, "-o", output, "--cluster")]
    assert run([*words, "distal"]) == 0 and run([*words, "distal"]) == 0
    assert "note" not in capsys.readouterr().err
    assert run([*words, "brim_lateral"]) == 0
    assert "brim_lateral has the same bench readings as distal" in capsys.readouterr().err


@pytest.mark.parametrize("units", ["{}", "[{}]", "({})"])
def test_units_may_stand_in_a_row_of_their_own(call, bench_file, output, units):
    call(bench_file, *WIRING)
    expected = read_calibration(output).clusters["distal"].to_document()
    output.unlink()
    header, *rows = bench_file.read_text().splitlines()
    titles, named = zip(
        *(title.rstrip("]").split(" [") for title in header.split(",")), strict=True
    )
    below = ["sec" if unit == "s" else unit for unit in named]
    # As an MTS export: a column of its own, in a unit of its own.
    lines = ["travel," + ",".join(titles), "mm," + ",".join(map(units.format, below))]
    bench_file.write_text("\n".join([*lines, *(f"1.5,{row}" for row in rows)]))
    call(bench_file, *WIRING)
    assert read_calibration(output).clusters["distal"].to_document() == expected


def test_raw_counts_and_forces_in_kilonewton_have_their_scale(call, tmp_path, output):
    bench = sensor_bench()
    call(write_bench(tmp_path / "bench.csv", bench), *WIRING)
    expected = read_calibration(output).clusters["distal"]
    output.unlink()
    counts = dataclasses.replace(
        bench, capacitance=np.round(bench.capacitance * 2**19), stress=bench.stress * 1e-3
    )
    header = ("time [s]", "normal [kN]", "shear_x [kN]", "shear_y [kN]")
    header += tuple(f"c{i} [counts]" for i in range(4))
    call(write_bench(tmp_path / "counts.csv", counts, header), "--area", 1e-3, *WIRING)
    found = read_calibration(output).clusters["distal"]
    np.testing.assert_allclose(found.normal, expected.normal, rtol=1e-4)
    np.testing.assert_allclose(found.mean_range, expected.mean_range, rtol=1e-4)
