"""Repeated trials of a condition against hand values: spread and smallest detectable differences.

Condition `gel` is the scene; `sock` its second trial, with 1.25 times the forces, and its first one
again. So a pressure p varies by s = 0.25 p / sqrt(2) between the trials of `sock`, with one degree
of freedom: t = 12.7062, and a t test sees 16.334 standard errors with a power of 80 %. The standard
error of the difference is s sqrt(1 / 2 + 1).

Both conditions are of one limb, whose errors correlate by 0.7: the sensors leave +-1.96 kPa to the
pressure of a tile, and +-1.5182 kPa, 1.96 sqrt(2 - 1.4), to its difference. At a power of 80 % the
latter counts (1.95996 + 0.84162) / 1.95996 = 1.42941 times, 2.1701 kPa.
"""

import numpy as np
import pandas as pd
import pytest
from support import scene
from support.pages import Page

import socket_testbed as st
from socket_testbed.results.comparison import Comparison
from socket_testbed.trials.trial import Trial


@pytest.fixture(scope="module")
def found(trial: Trial, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    folder = tmp_path_factory.mktemp("donnings")
    heavier = scene.write(folder / "a" / "heavier", second=True)
    again = scene.write(folder / "b" / "again")
    return st.compare(conditions={"gel": [trial], "sock": [heavier, again]}, segment="all")


@pytest.fixture(scope="module")
def page(found: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Page:
    path = tmp_path_factory.mktemp("page") / "donnings.html"
    st.write_comparison(found, path, "by hand")
    return Page(path.read_text(encoding="utf-8"))


def row_of(found: Comparison, part: str, name: str, item: str = "sock") -> pd.Series:
    """The row of a mean pressure in long form."""
    rows = found.to_dataframe().query("quantity == 'mean pressure'")
    return rows.set_index(["part", "name", "item"]).loc[(part, name, item)]


# --- numbers

DONNINGS = {
    # value, half width; difference, half width; spread; detectable [kPa]
    # 23.6667 and 29.5833 kPa: s = 4.18375, standard error 5.12403; 12.7062 * 4.18375 / sqrt(2)
    # = 37.589; 12.7062 * 5.12403 = 65.107; 16.334 * 5.12403 = 83.696
    ("regions", "anterior"): ((26.625, 37.640), (2.95833, 65.125), 4.18375, 83.724),
    # -1 and -1.25 kPa: s = 0.176777, standard error 0.216506
    ("tiles", "right_mid"): ((-1.125, 2.52272), (-0.125, 3.14212), 0.176777, 4.1491),
}


@pytest.mark.parametrize(("part", "name"), DONNINGS)
def test_donnings_widen_the_intervals(part: str, name: str, found: Comparison) -> None:
    (value, reach), (difference, far), spread, detectable = DONNINGS[part, name]
    row = row_of(found, part, name)
    values = [row[end] for end in ("low", "value", "high")]
    assert values == pytest.approx([value - reach, value, value + reach], rel=1e-4)
    changes = [row[f"difference{end}"] for end in (" low", "", " high")]
    assert changes == pytest.approx([difference - far, difference, difference + far], rel=1e-4)
    assert row["spread"] == pytest.approx(spread, rel=1e-4)
    assert row["detectable"] == pytest.approx(detectable, rel=1e-4)
    assert row["degrees of freedom"] == 1.0


def test_a_single_trial_has_the_spread_of_others(found: Comparison) -> None:
    """`gel`: 12.7062 * 0.176777 = 2.24616 kPa, with 1.96 kPa 2.98109 kPa about -1 kPa."""
    row = row_of(found, "tiles", "right_mid", "gel")
    assert [row["low"], row["high"]] == pytest.approx([-3.98109, 1.98109], rel=1e-4)
    assert np.isnan(row["detectable"]) and np.isnan(row["difference"])


# --- in words


def test_the_title_says_what_is_detectable(found: Comparison) -> None:
    """In the socket's 14.5348 kPa, and from `lateral middle`, -1 kPa, to `anterior middle`, 40 kPa.

    Socket: standard error 3.14689, +-1.82195 kPa of the sensors: |(2.0173, 51.401)|. `anterior
    middle`: standard error 8.66025: |(2.1701, 141.457)|.
    """
    assert found.title == (
        "with 1 to 2 trials per condition, differences of at least 51.4 kPa are detectable in the"
        " socket's mean pressure, of 4.1 to 141.5 kPa in that of its regions; segment all, in"
        " contact above 5 kPa"
    )


def test_cells_end_with_spread_and_detectable(found: Comparison) -> None:
    table = found.cells("regions", "mean pressure")
    assert [*table] == ["gel", "sock", "sock - gel", "spread", "detectable"]
    assert [*table.loc["lateral middle"]] == [
        *("-1.0 (-4.0 to 2.0)", "-1.1 (-3.6 to 1.4)", "-0.1 (-3.3 to 3.0)", "0.2", "4.1")
    ]


def test_spread_has_a_decimal_more_than_whole_values(found: Comparison) -> None:
    """`anterior` is in contact with all of its 27 cm^2 in every trial."""
    row = found.cells("regions", "contact area").loc["anterior"]
    assert [row["gel"], row["sock - gel"]] == ["27 (27 to 27)", "+0.0 (0.0 to 0.0)"]
    assert [row["spread"], row["detectable"]] == ["0.0", "0.0"]


def test_a_condition_names_its_trials(found: Comparison) -> None:
    assert found.kind == "conditions" and found.items == ("gel", "sock")
    texts = found.cells("trials")
    assert [*texts.loc[("trials", "")]] == ["scene", "heavier; again"]
    assert [*texts.loc[("samples", "")]] == ["96", "96"]  # equal texts once
    assert found.document()["conditions"] == {"gel": ["scene"], "sock": ["heavier", "again"]}


def test_notes_explain_the_spread(found: Comparison) -> None:
    (note,) = [note for note in found.notes if note.startswith("values are means")]
    assert "(degrees of freedom: 1)" in note
    assert note.endswith("detectable: the smallest difference that 80 % of such studies would tell"
                         " from 0")  # fmt: skip


# --- the page


def test_the_page_says_what_is_detectable(page: Page) -> None:
    assert "differences of at least 51.4 kPa are detectable in the socket's mean" in page.text
    assert "of 4.1 to 141.5 kPa in that of its regions; segment all" in page.text


def test_the_page_s_table_holds_spread_and_detectable(page: Page) -> None:
    captions = dict(zip(page.tables, page.said["caption"], strict=True))
    name = next(name for name, caption in captions.items() if caption == "mean pressure [kPa]")
    assert page.tables[name][0][1:] == ["gel", "sock", "sock - gel", "spread", "detectable"]
    assert page.rows(name)["lateral middle"][3:] == ["0.2", "4.1"]
    assert page.rows("trials-table")["trials"] == ["scene", "heavier; again"]
