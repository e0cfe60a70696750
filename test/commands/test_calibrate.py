"""The verb `calibrate`, from bench files to a calibration that the testbed reads."""

import dataclasses
import shutil

import numpy as np
import pytest
import yaml
from support import verbs
from support.benches import FULL_SCALE, HEADER, bench_of, nominal, sensor_bench, write_bench

from socket_testbed.calibration.model import invert_calibration, read_calibration
from socket_testbed.files import packaged

SOCKET, CALIBRATION = (packaged("config", f"{name}.yaml") for name in ("socket", "calibration"))
WIRING = ("--wiring", 2, 3, 0, 1)  # of the package's own 'distal', whose sensor is simulated


@pytest.fixture
def call(capsys, output):
    """Call the verb on cluster `distal`; gives what it printed, or it refuses and names these."""

    def called(*words, cluster="distal", named=()) -> str:
        words = ("calibrate", *words, "-o", output, "--cluster", cluster)
        if named:
            return verbs.refused(capsys, *words, named=named)
        code, out, err = verbs.call(capsys, *words)
        assert code == 0, err
        return out + err

    return called


@pytest.fixture
def output(tmp_path):
    return tmp_path / "calibration.yaml"


@pytest.fixture
def bench_file(tmp_path):
    return write_bench(tmp_path / "bench.csv", sensor_bench(play=0.04))


def record(path) -> dict:
    return yaml.safe_load(path.read_text())["clusters"]["distal"]["bench"]


def test_the_record_states_the_fit_s_quality(call, bench_file, output):
    out = call(bench_file, *WIRING)
    assert "18 cycles held out in turn" in out and "+- (95 %)" in out
    stored = record(output)
    assert 3.5 < stored["hysteresis_percent"]["normal"] < 4.5
    # No load was of shear alone: that is said instead of a number.
    talk = stored["cross_talk_percent"]
    assert talk["normal"] is None and "no pure shear" in out
    assert 0.0 < talk["shear_x"] < 3.0 and "no pure normal" not in out


def test_the_record_states_its_source(call, bench_file, output):
    call(bench_file, *WIRING)
    stored = record(output)
    assert (stored["source"], stored["readings"]) == ("bench.csv", 1062)
    calibration = read_calibration(output)
    assert calibration.source == "distal: bench.csv" and calibration.date == stored["date"]
    assert calibration.clusters["distal"].bench == stored


def test_cross_talk_is_the_coupling_of_the_sensor(call, tmp_path, output):
    """Full shear x feels like so much of the full normal stress, and the other way round."""
    ramp = np.concatenate([np.linspace(0.0, 1.0, 15), np.linspace(1.0, 0.0, 15)])
    pure = [np.outer(ramp, [0.0, side * FULL_SCALE[1], 0.0]) for side in (1.0, -1.0) * 2]
    applied = np.concatenate([sensor_bench().stress, *pure])
    felt = applied / FULL_SCALE
    felt[:, :2] += 0.06 * felt[:, 1::-1]
    bench = bench_of(invert_calibration(nominal(), felt * FULL_SCALE), applied)
    call(write_bench(tmp_path / "bench.csv", bench), *WIRING, "--force")
    found = record(output)["cross_talk_percent"]
    assert found["normal"] == pytest.approx(6.0, rel=0.1)
    # Normal stress has one sign: the fit's constant takes its mean, a third, off the shear.
    assert 3.0 <= found["shear_x"] <= 6.1 and found["shear_y"] < 0.3


def test_one_cluster_of_a_file_is_replaced(call, bench_file, output):
    """Its wiring is that of the existing cluster."""
    shutil.copyfile(CALIBRATION, output)
    old = read_calibration(output)
    out = call(bench_file)
    assert "distal replaced" in out and "kept: brim_lateral, mid_anterior" in out
    new = read_calibration(output)
    assert list(new.clusters) == list(old.clusters)
    for name, cluster in old.clusters.items():
        same = new.clusters[name].to_document() == cluster.to_document()
        assert same == (name != "distal")
    np.testing.assert_array_equal(new.clusters["distal"].wiring, nominal().wiring)


def test_another_file_is_replaced_only_when_asked(call, bench_file, output):
    call(bench_file, "--into", CALIBRATION, *WIRING)
    assert list(read_calibration(output).clusters) == list(read_calibration(CALIBRATION).clusters)
    call(bench_file, "--into", CALIBRATION, *WIRING, named=["exists already"])
    call(bench_file, "--into", CALIBRATION, *WIRING, "--replace")


@pytest.fixture
def bad(tmp_path):
    """A bench file whose hysteresis exceeds the limit."""
    return write_bench(tmp_path / "bench.csv", sensor_bench(play=0.3))


def test_a_bad_fit_is_drawn_but_refused(call, bad, tmp_path, output):
    drawn = ("--figure", tmp_path / "fit.pdf")
    call(bad, *WIRING, *drawn, named=["exceeds 10 %", "normal 1", "--force"])
    assert not output.exists() and (tmp_path / "fit.pdf").read_bytes().startswith(b"%PDF")


def test_a_forced_fit_is_recorded_as_such(call, bad, output):
    call(bad, *WIRING, "--force")
    assert record(output)["forced"] is True


def test_outliers_left_out_are_recorded(call, tmp_path, output):
    bench = sensor_bench(play=0.04)
    bench.stress[[200, 500], 1] += 60e3
    out = call(write_bench(tmp_path / "out.csv", bench), *WIRING, "--drop-outliers")
    assert "2 outliers, left out of the fit" in out
    assert record(output)["outliers"] == ["out.csv line 202", "out.csv line 502"]


def test_baselines_take_the_drift_off(call, tmp_path, output):
    files, unloaded = [tmp_path / "before.csv", tmp_path / "after.csv"], sensor_bench().capacitance
    for path, capacitance in zip(files, (unloaded[0], unloaded[0] + 0.2), strict=True):
        spike = capacitance + 9.0  # which a median does not see
        rows = [",".join(f"{c:.9g}" for c in row) for row in (capacitance, capacitance, spike)]
        path.write_text("\n".join([",".join(HEADER[4:]), *rows]))
    out = call(write_bench(tmp_path / "bench.csv", sensor_bench()), *WIRING, "--baseline", *files)
    assert "drift, corrected" in out and "above the limit" in out
    found = read_calibration(output).clusters["distal"]
    np.testing.assert_allclose(found.baseline, unloaded[0], rtol=1e-8)
    assert found.bench["drift"]["flagged"] is True


def test_forces_are_stresses_over_the_tile_s_area(call, tmp_path, output):
    bench = sensor_bench()
    header = ("time [s]", "normal [N]", "shear_x [N]", "shear_y [N]", *HEADER[4:])
    newtons = dataclasses.replace(bench, stress=bench.stress * 9e-4 * 1e3)

    def gain(path, *words) -> float:
        call(path, *words, *WIRING)
        return read_calibration(output).clusters["distal"].normal[1]

    by_force = gain(write_bench(tmp_path / "newtons.csv", newtons, header), "--geometry", SOCKET)
    by_stress = gain(write_bench(tmp_path / "pascals.csv", bench))
    assert by_force == pytest.approx(by_stress, rel=1e-6)


def test_a_wrong_sign_is_found_out(call, tmp_path, output):
    bench = sensor_bench()
    upside_down = bench_of(12.0 - bench.capacitance, bench.stress)
    path = write_bench(tmp_path / "upside_down.csv", upside_down)
    call(path, *WIRING, "--force", named=["gain of the normal stress"])
    assert not output.exists()


def test_a_wrong_wiring_is_found_out(call, bench_file, output):
    call(bench_file, "--wiring", 2, 3, 1, 0, named=["exceeds 10 %", "shear_x 4"])
    assert not output.exists()
