"""Contact laws that the package does not have: fitted, stored and refused by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import problems

from socket_testbed.errors import ConfigurationError
from socket_testbed.identification.contact import LAWS, ContactLaw, PaperLaw, register_law
from socket_testbed.identification.fit import fit_contact_model
from socket_testbed.identification.model_file import read_model, write_model
from socket_testbed.settings import identification
from socket_testbed.settings.identification import IdentificationSettings


class Doubled(PaperLaw):
    """The published law with twice the force per stiffness."""

    def columns(self, moved):
        return 2.0 * super().columns(moved)


pytestmark = pytest.mark.usefixtures("own_laws")


def fitted(variant: str, stiffness_difference: float):
    """A fit to a bed with offsets, whose Stage 1 is alike for every law."""
    geometry, _, samples, settings = problems.make_case(7, initial_stiffness=3000.0)
    changes = {"variant": variant, "stiffness_difference": stiffness_difference}
    return fit_contact_model(samples, geometry, replace(settings, **changes)), samples


@pytest.mark.parametrize("offsets", [False, True], ids=["without offsets", "with offsets"])
def test_twice_the_force_halves_the_stiffness(offsets):
    register_law("doubled", Doubled, offsets)
    own, samples = fitted("doubled", 500.0)
    usual, _ = fitted("stiffness_bias" if offsets else "stiffness", 1000.0)
    assert own.model.variant == "doubled" and own.model.stiffness.max() > 100.0
    np.testing.assert_allclose(own.model.stiffness, 0.5 * usual.model.stiffness, atol=0.1)
    assert bool(own.model.force_bias) is offsets
    wrenches = (each.model.wrench(samples.pose) for each in (own, usual))
    np.testing.assert_allclose(*wrenches, atol=0.01)


def test_a_file_of_it_needs_its_law(tmp_path: Path):
    register_law("doubled", Doubled)
    own, samples = fitted("doubled", 500.0)
    path = tmp_path / "model.json"
    write_model(own, path)
    forces = [each.model.forces(samples.pose) for each in (own, read_model(path))]
    np.testing.assert_array_equal(*forces)
    del LAWS["doubled"]
    with pytest.raises(ConfigurationError) as refused:
        read_model(path)
    assert str(refused.value) == (
        f"{path}: parameters: variant: the contact law 'doubled' is unknown: name one of the"
        " package's, or register its law first, with st.register_law"
    )


def test_a_law_registered_again_replaces_the_first():
    register_law("own", PaperLaw, offsets=True)
    register_law("own", Doubled)
    assert LAWS["own"] is Doubled
    assert identification.VARIANTS.count("own") == 1 and "own" not in identification.BIAS_VARIANTS


def test_settings_take_registered_laws_alone():
    with pytest.raises(ConfigurationError, match="variant"):
        IdentificationSettings(variant="doubled")
    register_law("doubled", Doubled)
    assert IdentificationSettings(variant="doubled").variant == "doubled"


REFUSED = {
    "the package's name": (
        "rigid", PaperLaw,
        "the law's name 'rigid' is that of one of the package's: give it a name of its own, such as"
        " 'hardening'",
    ),
    "no name": (
        "my law", PaperLaw,
        "the law's name 'my law' is no identifier: give it a name of its own, such as 'hardening'",
    ),
    "another class": (
        "own", dict,
        "the law of 'own' is no complete ContactLaw: derive a class from it that defines its"
        " methods",
    ),
    "an incomplete law": (
        "own", ContactLaw,
        "the law of 'own' is no complete ContactLaw: derive a class from it that defines columns,"
        " motion, motion_map, reference_of, sizes",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "law", "line"), REFUSED.values(), ids=[*REFUSED])
def test_a_wrong_law_is_refused(name, law, line):
    with pytest.raises(ConfigurationError) as refused:
        register_law(name, law)
    assert str(refused.value) == line and "own" not in LAWS
