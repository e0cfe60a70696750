import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.damage import changed
from support.problems import make_case
from support.wording import refused

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.fit import evaluate, fit_contact_model
from socket_testbed.identification.model_file import read_model, write_model


@pytest.mark.parametrize("variant", ["stiffness_bias", "rigid_bias"])
def test_a_model_reads_back_as_it_was_written(tmp_path: Path, variant) -> None:
    geometry, _, samples, settings = make_case(5, leave_out=("cluster_1.Fy",))
    fit = fit_contact_model(samples, geometry, replace(settings, variant=variant))
    path = tmp_path / "model.json"
    write_model(fit, geometry, {"name": "hold"}, "plateau", path)

    stored = read_model(path)
    assert (stored.settings, stored.samples, stored.trial) == (fit.settings, fit.samples, "hold")
    assert stored.last_stamp == fit.last_stamp
    np.testing.assert_array_equal(stored.model.stiffness, fit.model.stiffness)
    for name, bias in fit.model.force_bias.items():
        np.testing.assert_array_equal(stored.model.force_bias[name], bias)
    for before, kept, after in zip(
        fit.errors, stored.errors, evaluate(samples, stored.model), strict=True
    ):
        assert before == kept
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
