import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.bags import move_to_namespace, rewrite

from socket_testbed.__main__ import run
from socket_testbed.errors import CalibrationError, ConfigurationError, TrialError
from socket_testbed.files import atomic_output
from socket_testbed.samples import Status
from socket_testbed.simulation.trial import TRUTH_FILE, read_true_forces, read_truth
from socket_testbed.trials.bag import BagReader, BagWriter, required_topics
from socket_testbed.trials.layout import decode, encode, stamp_of
from socket_testbed.trials.topics import REQUIRED, WRENCH, match_topics
from socket_testbed.trials.trial import Trial, recorded_namespace


def test_samples_agree_with_the_truth_within_the_sensors_errors(hold: Path) -> None:
    samples, truth = Trial(hold).samples(), read_truth(hold)
    rows = samples.complete
    assert rows.mean() > 0.95
    assert np.abs(samples.wrench[rows] - truth.wrench[rows]).max() < 5.0
    shift = samples.position[rows] - truth.position[rows]
    assert np.abs(shift - shift.mean(axis=0)).max() < 2e-3
    geometry = Trial(hold).geometry
    for column, cluster in enumerate(samples.clusters):
        tile = geometry.clusters[cluster]
        actual = truth.forces[:, tile] @ geometry.rotations[tile]
        assert np.abs(samples.local_forces[:, column] - actual).max() < 8.0


def test_true_forces_are_those_of_the_simulated_tiles_alone(hold: Path, tmp_path: Path) -> None:
    samples, tiles = Trial(hold).samples(), Trial(hold).geometry.names
    forces = read_true_forces(hold, samples.stamps, tiles)
    assert forces is not None and forces.shape == (len(samples), len(tiles), 3)
    assert read_true_forces(hold, samples.stamps, [*tiles[:-1], "another"]) is None
    assert read_true_forces(tmp_path, samples.stamps, tiles) is None
    np.savez(tmp_path / TRUTH_FILE, forces=forces)
    with pytest.raises(TrialError, match=f"{TRUTH_FILE}: is damaged"):
        read_true_forces(tmp_path, samples.stamps, tiles)


def test_what_is_missing_at_a_trigger_is_nan_and_not_an_older_value(
    hold: Path, tmp_path: Path
) -> None:
    seen = {"/load_cell/wrench": 0, "/clusters/capacitance": 0}

    def drop(topic: str, message: object) -> object:
        if topic in seen:
            seen[topic] += 1
            if seen[topic] == 11:
                return None
        return message

    samples = Trial(rewrite(hold, tmp_path / "gap", drop)).samples()
    whole = Trial(hold).samples()
    assert len(samples) == len(whole)
    assert np.isnan(samples.wrench[10]).all() and np.isnan(samples.local_forces[10]).all()
    assert (samples.status[10] == Status.MISSING).all()
    keep = np.arange(len(whole)) != 10
    np.testing.assert_array_equal(samples.wrench[keep], whole.wrench[keep])


def test_the_order_of_recording_does_not_matter(hold: Path, tmp_path: Path) -> None:
    target = tmp_path / "shuffled"
    rng = np.random.default_rng(0)
    with BagReader(hold) as old, BagWriter(target) as new:
        names = match_topics(old.counts, "hold")
        for topic, name in names.items():
            new.add_topic(name, topic)
        messages = list(old.messages())
        for k in rng.permutation(len(messages)):
            new.write(messages[k].topic, messages[k].time, messages[k].data)
    for file in ("socket.yaml", "calibration.yaml"):
        shutil.copy(hold / file, target)
    np.testing.assert_array_equal(Trial(target).samples().values, Trial(hold).samples().values)


@pytest.mark.parametrize("topic", REQUIRED, ids=lambda topic: topic.name)
def test_a_missing_topic_is_named(hold: Path, tmp_path: Path, topic) -> None:
    target = tmp_path / "lacking"
    with BagReader(hold) as old, BagWriter(target) as new:
        names = match_topics(old.counts, "hold")
        for kept, name in names.items():
            if kept is not topic:
                new.add_topic(name, kept)
        for raw in old.messages():
            if raw.topic != names[topic]:
                new.write(raw.topic, raw.time, raw.data)
    with pytest.raises(TrialError, match=f"'{topic.name}'"):
        Trial(target).samples()


def test_an_empty_topic_is_named(hold: Path, tmp_path: Path) -> None:
    target = rewrite(
        hold, tmp_path / "mute", lambda topic, m: None if topic == "/load_cell/wrench" else m
    )
    with pytest.raises(TrialError, match="'/load_cell/wrench' holds no message"):
        Trial(target).samples()


def test_an_empty_bag_is_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "empty") as bag:
        for topic in REQUIRED:
            bag.add_topic("/" + topic.name, topic)
    with pytest.raises(TrialError, match="holds no message"):
        Trial(tmp_path / "empty").samples()


def test_a_bag_without_one_whole_chunk_is_named(hold: Path, tmp_path: Path) -> None:
    data = (hold / "hold.mcap").read_bytes()
    target = tmp_path / "hold"
    shutil.copytree(hold, target)
    for length in (0, 5, 40, len(data) // 2):
        (target / "hold.mcap").write_bytes(data[:length])
        fault = "holds nothing" if length <= 40 else "is truncated"
        with pytest.raises(TrialError, match=rf"hold\.mcap: {fault}"):
            Trial(target).samples()


def test_a_bag_that_lacks_its_end_alone_is_read_whole(hold: Path, tmp_path: Path) -> None:
    data = (hold / "hold.mcap").read_bytes()
    target = tmp_path / "hold"
    shutil.copytree(hold, target)
    (target / "hold.mcap").write_bytes(data[:-1])
    np.testing.assert_array_equal(Trial(target).samples().values, Trial(hold).samples().values)


def test_flipped_bytes_are_an_error_and_never_another_number(hold: Path, tmp_path: Path) -> None:
    whole = Trial(hold).samples().values
    target = tmp_path / "hold"
    shutil.copytree(hold, target)
    data = bytearray((hold / "hold.mcap").read_bytes())
    rng = np.random.default_rng(1)
    for start in rng.integers(len(data) - 4000, len(data) - 40, 20):
        damaged = bytearray(data)
        damaged[start : start + 4] = b"\xff\xff\xff\xff"
        (target / "hold.mcap").write_bytes(damaged)
        try:
            values = Trial(target).samples().values
        except (TrialError, CalibrationError):
            continue
        np.testing.assert_array_equal(values, whole)


def test_metadata_that_promises_other_counts_is_refused(hold: Path, tmp_path: Path) -> None:
    target = tmp_path / "hold"
    shutil.copytree(hold, target)
    metadata = yaml.safe_load((target / "metadata.yaml").read_text())
    entry = metadata["rosbag2_bagfile_information"]["topics_with_message_count"][0]
    entry["message_count"] += 7
    (target / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    with pytest.raises(TrialError, match=r"metadata.yaml lists 247 messages.*holds 240.*reindex"):
        Trial(target).samples()


@pytest.mark.parametrize("entry", ["text", {"message_count": 7}, {"topic_metadata": {"name": "x"}}])
def test_metadata_without_topics_and_counts_is_refused(entry, tmp_path: Path) -> None:
    content = {"relative_file_paths": [], "topics_with_message_count": [entry]}
    text = yaml.safe_dump({"rosbag2_bagfile_information": content})
    (tmp_path / "metadata.yaml").write_text(text)
    with pytest.raises(TrialError, match=r"is not rosbag2 metadata: .*reindex"):
        Trial(tmp_path).samples()


def test_a_trial_without_metadata_is_read_from_its_files(hold: Path, tmp_path: Path) -> None:
    target = tmp_path / "hold"
    shutil.copytree(hold, target)
    (target / "metadata.yaml").unlink()
    assert len(Trial(target).samples()) == len(Trial(hold).samples())


def test_a_disagreement_on_qos_hides_no_message(shared_data: Path) -> None:
    with BagReader(shared_data / "rosbag2" / "talker") as bag:
        assert bag.counts["/topic"] == 10
        assert len(list(bag.messages(["/topic"]))) == 10
        with pytest.raises(TrialError, match="has no topic 'trigger'"):
            required_topics(bag)


def test_topics_are_found_in_the_namespace_they_were_recorded_in(
    hold: Path, tmp_path: Path
) -> None:
    target = move_to_namespace(hold, tmp_path / "lab", "/lab")
    assert recorded_namespace(Trial(target)) == "/lab"
    assert recorded_namespace(Trial(hold)) == "/"
    np.testing.assert_array_equal(Trial(target).samples().values, Trial(hold).samples().values)


def test_two_testbeds_in_one_bag_are_refused() -> None:
    with pytest.raises(TrialError, match="two topics"):
        match_topics(["/a/trigger", "/b/trigger"], "bag")


def test_a_calibration_of_other_clusters_is_refused(hold: Path, tmp_path: Path) -> None:
    text = (hold / "calibration.yaml").read_text().replace("mid_anterior", "mid_posterior")
    other = tmp_path / "calibration.yaml"
    other.write_text(text)
    with pytest.raises(CalibrationError, match="no cluster mid_anterior"):
        Trial(hold, calibration_file=other).samples()


def test_a_trial_without_its_configuration_says_what_to_give(hold: Path, tmp_path: Path) -> None:
    target = tmp_path / "hold"
    shutil.copytree(hold, target)
    (target / "socket.yaml").unlink()
    with pytest.raises(TrialError, match=r"no socket\.yaml.*--geometry"):
        Trial(target).samples()
    assert len(Trial(target, socket_file=hold / "socket.yaml").samples()) == 240


def test_messages_survive_a_round_trip(hold: Path) -> None:
    with BagReader(hold) as bag:
        for raw in bag.messages():
            assert encode(decode(raw.data, raw.type), raw.type) == raw.data
    with BagReader(hold) as bag:
        stamps = [stamp_of(decode(r.data, r.type)) for r in bag.messages(["/trigger"])]
    assert np.all(np.diff(stamps) == 250_000_000)


def test_a_bag_is_readable_up_to_its_last_flush(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    bag.__enter__()
    bag.add_topic("/load_cell/wrench", WRENCH)
    bag.write("/load_cell/wrench", 1, b"\x00\x01\x00\x00")
    bag.flush()
    size = (tmp_path / "bag" / "bag.mcap").stat().st_size
    assert size > 100
    bag.flush()  # nothing new: nothing written
    assert (tmp_path / "bag" / "bag.mcap").stat().st_size == size
    bag.__exit__(None, None, None)
    with BagReader(tmp_path / "bag") as reader:
        assert reader.counts == {"/load_cell/wrench": 1}


def test_an_output_that_fails_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), atomic_output(tmp_path / "out") as staging:
        staging.write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(ConfigurationError, match="cannot be written"),
        atomic_output(Path("/proc/out")) as staging,
    ):
        staging.write_text("x")


def shift_stamps(source: Path, target: Path, topics: set[str], first: int, by: int) -> Path:
    """Copy a trial with the stamps of some topics shifted by `by` [ns] from message `first` on."""
    seen = dict.fromkeys(topics, 0)

    def change(topic: str, message: Any) -> Any:
        if topic in seen:
            seen[topic] += 1
            if seen[topic] > first:
                stamp = message.header.stamp
                total = stamp_of(message) + by
                stamp.sec, stamp.nanosec = divmod(total, 10**9)
        return message

    return rewrite(source, target, change)


def test_stamps_that_jump_back_are_counted_and_named(
    hold: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrench = "/load_cell/wrench"
    target = shift_stamps(hold, tmp_path / "back", {wrench}, 40, -5 * 10**9)
    notes: list[str] = []
    Trial(target, notify=notes.append).samples()
    back, doubled = notes
    assert back.startswith("the stamps of load_cell/wrench jump back, once (from 9.75 s to 5.0")
    assert doubled.startswith("the stamps of load_cell/wrench are doubled, 20 times (at 5.00 s")
    assert "20 earlier values are replaced" in doubled and "and 17 more" in doubled
    capsys.readouterr()
    assert run(["info", str(target)]) == 0
    assert capsys.readouterr().out.count("note: ") == 2


def test_a_doubled_stamp_is_named(hold: Path, tmp_path: Path) -> None:
    seen = []

    def double(topic: str, message: Any) -> Any:
        if topic == "/load_cell/wrench":
            seen.append(message.header.stamp)
            if len(seen) == 13:
                message.header.stamp = seen[-2]
        return message

    notes: list[str] = []
    target = rewrite(hold, tmp_path / "doubled", double)
    Trial(target, notify=notes.append).samples()
    (note,) = notes
    assert note.startswith("the stamps of load_cell/wrench are doubled, once (at 2.75 s)")


def test_a_trial_with_sound_stamps_has_no_note(hold: Path) -> None:
    notes: list[str] = []
    Trial(hold, notify=notes.append).samples()
    assert notes == []
