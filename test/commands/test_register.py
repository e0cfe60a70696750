"""`register`: what it prints and writes. Its files: test_documents.py, test_registration.py."""

import copy

import numpy as np
import pytest
from support import verbs
from support.takes import Bench, between, make_bench, write_landmarks, write_take

from socket_testbed.geometry.socket import read_socket, write_socket


@pytest.fixture
def files(rng, tmp_path) -> tuple[Bench, list[object]]:
    bench = make_bench(rng, placement=3e-4)
    bench.take.markers["Cell:2"][:7] = np.nan
    take = write_take(bench.take, tmp_path / "take.csv")
    landmarks = write_landmarks(bench.document, tmp_path / "landmarks.yaml")
    write_socket(bench.geometry, tmp_path / "socket.yaml")
    return bench, ["register", take, "--landmarks", landmarks, "--socket", tmp_path / "socket.yaml"]


def test_the_verb_writes_the_registered_socket(files, tmp_path, capsys):
    bench, words = files
    old = (tmp_path / "socket.yaml").read_bytes()
    code, out, _ = verbs.call(capsys, *words, "-o", tmp_path / "new.yaml")
    assert code == 0 and (tmp_path / "socket.yaml").read_bytes() == old
    new = read_socket(tmp_path / "new.yaml")
    assert new.same_tiles(bench.geometry) and new.clusters == bench.geometry.clusters
    x, y, z = (f"{1e3 * value:.2f}" for value in new.limb.translation)
    assert "53 frames used, 7 left out (7 occluded" in out and f"at ({x}, {y}, {z}) mm" in out


@pytest.fixture
def landmarks(files, tmp_path):
    """The file of landmarks, one of which is 50 mm off."""
    bench, _ = files
    bad = copy.deepcopy(bench.document)
    bad["limb"]["Limb:2"][0] += 0.05
    return write_landmarks(bad, tmp_path / "landmarks.yaml")


@pytest.mark.usefixtures("landmarks")
def test_a_wrong_landmark_leaves_the_socket_alone(files, tmp_path, capsys):
    _, words = files
    socket = tmp_path / "socket.yaml"
    old = socket.read_bytes()
    named = ["limb: landmark Limb:2 is", "at most 10 mm", "--force"]
    verbs.refused(capsys, *words, named=named)
    assert socket.read_bytes() == old


def test_without_an_output_the_socket_is_replaced(files, landmarks, tmp_path, capsys):
    bench, words = files
    socket = tmp_path / "socket.yaml"
    assert verbs.call(capsys, *words, "--force")[0] == 0
    forced = read_socket(socket)
    write_landmarks(bench.document, landmarks)
    assert verbs.call(capsys, *words)[0] == 0
    right = read_socket(socket)
    assert between(forced.limb, bench.limb)[0] > 0.005 > between(right.limb, bench.limb)[0]
