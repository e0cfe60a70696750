import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from support.damage import changed
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.evaluation import evaluate
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.settings.identification import IdentificationSettings, PlateauSettings
from socket_testbed.trials.segment import select_segment
from socket_testbed.trials.trial import Trial


@pytest.mark.parametrize("variant", ["stiffness_bias", "rigid_bias"])
def test_a_model_reads_back_as_it_was_written(hold: Path, tmp_path: Path, variant) -> None:
    trial = Trial(hold)
    samples = trial.samples()
    samples = samples[select_segment(samples, "plateau", PlateauSettings()).rows]
    settings = IdentificationSettings(variant=variant, leave_out=("distal.Fy",))
    fit = fit_contact_model(samples, trial.geometry, settings)
    path = tmp_path / "model.json"
    write_model(fit, trial.geometry, {"name": "hold"}, "plateau", path)

    stored = read_model(path)
    assert (stored.settings, stored.samples, stored.trial) == (settings, fit.samples, "hold")
    assert stored.last_stamp == fit.last_stamp
    np.testing.assert_array_equal(stored.model.stiffness, fit.model.stiffness)
    for name, bias in fit.model.force_bias.items():
        np.testing.assert_array_equal(stored.model.force_bias[name], bias)
    for before, kept, after in zip(
        fit.errors, stored.errors, evaluate(samples, stored.model), strict=True
    ):
        assert dataclasses.astuple(before) == dataclasses.astuple(kept)
        assert after.rmse == pytest.approx(before.rmse, abs=1e-5)


SPOILT = (
    (("format",), "socket_testbed model 0", "is of the format 'socket_testbed model 0': fit the"),
    (("parameters", "stiffness"), [[1.0, 2.0, 3.0]], "stiffness has 1 rows for "),
    (("parameters", "rest_positions", 1, 2), 1e300, "rest_positions[1][2] is 1e+300: give"),
    (("parameters", "force_bias", "elsewhere"), [0, 0, 0], "unknown key 'elsewhere'"),
    (("parameters", "clusters"), ["nowhere"], "clusters: no cluster 'nowhere'"),
    (("settings", "noise_correction"), True, "unknown key"),  # such a fit cannot be repeated
)


def test_a_spoilt_model_is_refused_and_one_of_an_older_version_is_read(hold_model, tmp_path):
    path, text = tmp_path / "model.json", hold_model.read_text()
    for place, value, error in SPOILT:
        path.write_text(json.dumps(changed(json.loads(text), place, value)))
        with refused(ConfigurationError, str(path), error):
            read_model(path)
    document = json.loads(text)
    document["quality"].pop("errors")
    document["parameters"]["parameter_factor"] = ["0 1 2"]
    document["settings"]["noise_correction"] = False
    path.write_text(json.dumps(document))
    assert read_model(path).errors == ()
