"""The outline of a report on the scene: its headings, tables, columns, rows and files.

Others link to headings and tables, and read the files by their names and titles.
"""

import csv
from typing import Any

import pytest

# --- headings and tables

HEADINGS = {
    "h2": [
        *("Numbers", "Pressure"),
        *("Model", "Fitted models", "Wrench", "Local forces", "Errors", "Validation"),
        *("Pareto fronts", "This trial and the paper", "Parameters on the socket's surface"),
        *("Data", "Notes", "Data quality", "Provenance"),
    ],
    "h3": [
        *("Regions", "Estimation", "Held-out: the rest of the trial", "Load shares"),
        *("Information in the pose", "The segment", "Noise", "Solver certificates"),
        "Settings of identification, plateaus and force map",
    ],
}
SECTIONS = [
    *("socket", "pressure", "models", "wrench", "local", "errors-section", "validation", "fronts"),
    *("paper-section", "surface", "notes", "quality", "provenance"),
]
TABLES = {
    "pressure-regions": "Pressure and load by region, the 95 % interval below each value",
    "pressure-shear": "Shear and centre of pressure by region, the 95 % interval below each value",
    "limb": "Limb in the socket, about the centre of the tiles",
    "errors": "Errors over the segment (in-sample), in the unit of the channel",
    "held-out": "Errors over the rest of the trial (held-out), in the unit of the channel",
    "cluster-left-out": "Force on a left-out cluster, from the others and the wrench",
    "tiles-second-half": "Force on the tiles without a sensor, against the simulated truth",
    "wrench-second-half": "Wrench from the pose alone, fitted on the other half of the trial",
    "wrench-in-sample": "Wrench from the pose alone, IN-SAMPLE: on the fitted half",
    "shares": "Shares of the measured load over the segment",
    "marks": ("The marked solutions of each front, with RMSE of the channels in the objective"),
    "paper": (
        "The figures of the paper, for its variants; 'paper' computes more, with its settings"
    ),
    "offsets": "Constant offsets, added to the springs' predictions",
    "drop-outs": "Samples of the trial without a measurement",
    "plateaus": "Load of parts of the trial",
    "noise": "Standard deviation of the noise of a single sample, along each axis",
    "provenance-table": "Inputs and software of the report",
    "kkt": "Residuals of both stages of each fit, and the largest of each front",
    "settings": "Settings by name in testbed.yaml",
}


@pytest.mark.parametrize("tag", HEADINGS)
def test_headings_are_in_order(tag: str, report: Any) -> None:
    assert [text.strip() for text in report.page.said[tag]] == HEADINGS[tag]


def test_sections_are_in_order(report: Any) -> None:
    assert [a.get("id") for tag, a in report.page.tags if tag == "section"] == SECTIONS


def test_tables_have_their_captions(report: Any) -> None:
    assert dict(zip(report.page.tables, report.page.said["caption"], strict=True)) == TABLES


# --- columns and rows

CHANNELS = [
    *("Mx", "My", "Mz", "Fx", "Fy", "Fz"),
    *(f"{name}.F{axis}"
      for name in ("brim_lateral", "mid_anterior", "posterior_distal", "distal") for axis in "xyz"),
]  # fmt: skip
ERRORS = [
    *("mean moment RMSE in the objective", "mean force RMSE in the objective"),
    *("median local RMSE in the objective", "median skill in the objective"),
]
FOUR = ["RMSE", "MAE", "sigma", "skill [-]"]
VARIANTS = ["stiffness", "stiffness_bias", "rigid_bias"]
JUDGED = ["error [-]", "in 50 % [%]", "in 80 % [%]", "in 95 % [%]"]
WRENCH = ["moment RMSE [N m]", "force RMSE [N]", "moment skill [-]", "force skill [-]"]
SHARES = ["springs [%]", "offsets [%]", "residual [%]"]
RMSE = ["mean moment RMSE [N m]", "mean force RMSE [N]", "median local RMSE [N]"]
REGIONS = [
    *("anterior", "posterior", "medial", "lateral", "proximal", "middle", "distal"),
    *(f"{side} {part}" for side in ("anterior", "posterior", "medial", "lateral")
      for part in ("proximal", "middle", "distal")),
    *("tibia", "fibula", "unmeasured wall", "socket"),
]  # fmt: skip
OUTLINES: dict[str, tuple[list[str], list[str]]] = {
    # titles of the columns, names of the rows
    "pressure-regions": (
        ["region", "peak pressure [kPa]", "mean pressure [kPa]", "contact area [cm²]",
         "pressure-time integral [kPa s]", "share of load [%]"],
        REGIONS,
    ),
    "pressure-shear": (
        ["region", "shear [kPa]", "shear direction [deg]",
         *(f"centre of pressure {axis} [mm]" for axis in "xyz")],
        REGIONS,
    ),
    "limb": (
        ["", "over the segment"],
        ["pistoning [mm]", *(f"range of rotation about {axis} [deg]" for axis in "xyz"),
         *(f"stiffness F{axis} [N/mm]" for axis in "xyz"),
         *(f"stiffness M{axis} [N m/deg]" for axis in "xyz")],
    ),
    "errors": (["channel", "unit", *3 * FOUR, "remark"], CHANNELS + ERRORS),
    "held-out": (["channel", "unit", *3 * FOUR, "remark"], CHANNELS + ERRORS),
    "cluster-left-out": (
        ["predictor", *JUDGED], ["inverse distance", "inverse distance, wrench met", "force map"]
    ),
    "tiles-second-half": (["predictor", *JUDGED], ["inverse distance", "force map"]),
    "wrench-second-half": (["predictor", *WRENCH], ["best constant", "rigid_bias"]),
    "wrench-in-sample": (["predictor", *WRENCH], ["best constant", "rigid_bias"]),
    "shares": (["measured", *3 * SHARES], ["Fz", "force", "moment"]),
    "marks": (
        ["variant", "solution", "theta [-]", "wrench error [-]", "local error [-]", *RMSE,
         "remark"],
        [*["stiffness"] * 3, *["stiffness_bias"] * 3],
    ),
    "paper": (
        ["figure", *2 * ["without offsets", "with offsets"], "remark"],
        [
            *RMSE,
            *(f"RMSE of M{axis} [N m]" for axis in "xyz"),
            *("RMSE of Fy [N]", "RMSE of Fz [N]"),
            *(f"RMSE of brim_lateral.F{axis} [N]" for axis in "xyz"),
            *(f"RMSE of mid_anterior.F{axis} [N]" for axis in "xz"),
            *(f"RMSE of posterior_distal.F{axis} [N]" for axis in "yz"),
            *("RMSE of distal.Fz [N]", "sigma of Mx [N m]"),
            *("load [N]", "mass of the pylon [kg]", "mass placed on the pylon [kg]"),
            *("duration of the hold [min]", "samples [1]", "rate [Hz]"),
            *("rest position limit [mm]", "clusters [1]", "edge of a tile [mm]"),
            *("markers per body [1]", "cluster channels in the objective [1]"),
            *("cluster channels left out [1]", "largest force left out [N]"),
        ],
    ),
    "offsets": (
        ["channel", "unit", *(f"offset {name} [unit of the row]" for name in VARIANTS[1:])],
        CHANNELS,
    ),
    "drop-outs": (
        ["measurement", "missing [1]", "missing [%]", "of them in the segment [1]", "longest [s]",
         "saturated [1]", "out of range [1]"],
        [*CHANNELS[:6], "limb position", "brim_lateral", "mid_anterior", "posterior_distal",
         "distal"],
    ),
    "plateaus": (
        ["part", "duration [s]", "mean force [N]", "its sigma [N]", "mean moment [N m]",
         "its sigma [N m]"],
        ["all 0.00 s to 11.75 s"],
    ),
    "noise": (
        ["measurement", "x", "y", "z"],
        ["moment [N m]", "force [N]", "limb position [mm]", "limb rotation [mrad]",
         "brim_lateral [N]", "mid_anterior [N]", "posterior_distal [N]", "distal [N]"],
    ),
    "kkt": (
        ["variant", "stage", "bound violation [-]", "stationarity [-]", "duality gap [-]", "solver",
         "determined stiffnesses"],
        ["stiffness", "stiffness", "stiffness_bias", "stiffness_bias", *["rigid_bias"] * 3,
         "stiffness", "stiffness_bias"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("table", OUTLINES)
def test_a_table_has_its_columns_and_rows(table: str, report: Any) -> None:
    titles, names = OUTLINES[table]
    rows = report.page.tables[table]
    heads = 1 + rows.index(next(row for row in rows if row[0] == titles[0] and row[1] == titles[1]))
    assert rows[heads - 1] == titles
    assert [row[0] for row in rows[heads:]] == names


@pytest.mark.parametrize(
    ("table", "groups"),
    [
        ("errors", ["", "", *VARIANTS, ""]),
        ("shares", ["", *VARIANTS]),
        ("paper", ["", "this trial", "the paper", ""]),
    ],
)
def test_grouped_columns_name_their_groups(table: str, groups: list[str], report: Any) -> None:
    assert report.page.tables[table][0] == groups


# --- files

PLACE = ["tile", "cluster", *(f"anchor {axis} in S [m]" for axis in "xyz")]
IN_TIME = ["stamp [ns]", "time [s]", "in segment"]
SPRINGS = ["engaged [1]", "engaged_share [-]", "uncertain_share [-]"]
FILES: dict[str, list[str]] = {
    "engaged_springs": [
        *IN_TIME, *(f"{name}.springs.{title}" for name in VARIANTS for title in SPRINGS)
    ],
    "engaged_tiles": [
        "tile", *(f"{name}.{axis} engaged [-]" for name in VARIANTS[:2] for axis in "xyz"),
        "rigid_bias.normal engaged [-]",
    ],
    "errors": [
        "model", "samples of", "channel", "unit of RMSE, MAE, sigma", "in objective", "samples [1]",
        "RMSE", "MAE", "sigma", "skill [-]",
    ],
    "force_map": [
        "tile", "cluster", "pressure [kPa]", "pressure sd [kPa]", "shear [kPa]", "shear sd [kPa]"
    ],
    "local_forces": [
        *IN_TIME,
        *(f"{channel} {what} [N]" for channel in CHANNELS[6:]
          for what in ("measured", *(f"predicted {name}" for name in VARIANTS))),
    ],
    "wrench": [
        *IN_TIME,
        *(f"{channel} {what} [{'N' if channel[0] == 'F' else 'N m'}]"
          for channel in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
          for what in ("measured", *(f"predicted {name}" for name in VARIANTS))),
    ],
    "offsets": ["channel", "unit", *(f"offset {n} [unit of the row]" for n in VARIANTS[1:])],
    "overview": [
        *IN_TIME, "force magnitude [N]", "moment magnitude [N m]",
        *(f"{name} not usable [-]" for name in (
            *CHANNELS[:6], "limb position", "brim_lateral", "mid_anterior", "posterior_distal",
            "distal")),
    ],
    "pressure_map": ["tile", "mean over the segment [kPa]", "at the peak, 12.00 s [kPa]"],
    "rest_positions": [
        *PLACE, *(f"rest position from the mean limb position {axis} [mm]" for axis in "xyz")
    ],
    "rest_positions_rigid_bias": [
        *PLACE, *(f"rest position from the reference pose {axis} [mm]" for axis in "xyz")
    ],
    **{
        f"tile_stiffness_{name}": [*PLACE, *(f"stiffness {axis} [N/m]" for axis in "xyz")]
        for name in VARIANTS
    },
}  # fmt: skip
OTHERS = {"pareto", "pressure", "pressure_of_regions", "validation"}  # read by other tests


@pytest.mark.parametrize("name", FILES)
def test_a_file_has_its_titles(name: str, report: Any) -> None:
    with (report.files / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        assert next(csv.reader(file)) == FILES[name]


def test_the_folder_holds_these_files(report: Any) -> None:
    names = {f"{name}.csv" for name in (*FILES, *OTHERS)}
    assert {path.name for path in report.files.iterdir()} == names
