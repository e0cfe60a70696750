"""The fitted parameters on the socket's surface in 3D, as a section of the page."""

from __future__ import annotations

import html
import json

import numpy as np

from socket_testbed.arrays import FloatArray
from socket_testbed.report.figures import rest_offsets
from socket_testbed.report.markup import paragraph, section
from socket_testbed.report.results import Candidate, Results
from socket_testbed.samples import LOCAL_CHANNELS
from socket_testbed.view.value_scene import SCENE_ID, value_scene

_AXES = "xyz"
_SCRIPT = """\
<script>
(function () {
  const visible = %s;
  const model = document.getElementById("model"), value = document.getElementById("value");
  function limit() {
    for (const option of value.options) {
      option.disabled = !((model.value + " " + option.value) in visible);
    }
    if (value.selectedOptions[0].disabled) { value.selectedIndex = 0; }
  }
  function show() {
    limit();
    Plotly.restyle("%s", {visible: visible[model.value + " " + value.value]});
  }
  model.addEventListener("change", show);
  value.addEventListener("change", show);
  limit();
})();
</script>"""


def scene_section(results: Results, maps: str) -> str:
    """The scene, its switches and the figures of the same values for paper.

    Args:
        results: The results.
        maps: HTML of those figures.
    """
    values = {
        f"{candidate.label} {quantity}": of_tiles
        for candidate in results.candidates
        for quantity, of_tiles in _values(results, candidate).items()
    }
    scene = value_scene(results.trial.geometry, values)
    models = [candidate.label for candidate in results.candidates]
    quantities = list(dict.fromkeys(key.partition(" ")[2] for key in values))
    return section(
        "surface",
        "Parameters on the socket's surface",
        [
            paragraph(
                "Drag to turn, scroll or pinch to zoom; point at a tile for its name and value. The"
                " colour scale is that of the chosen values; tiles without a value are white, tiles"
                " with a cluster outlined. {S} is the frame of the load cell. A rest position"
                " is given from the mean limb position of the segment. The offset of a cluster"
                " is in the cluster's own frame; the wrench's offset belongs to no tile."
            ),
            '<div class="switches">'
            + _select("model", "Model", models)
            + _select("value", "Shown", quantities)
            + "</div>",
            f'<div class="scene">{scene.html}</div>',
            _SCRIPT % (_json(scene.visible), SCENE_ID),
            maps,
        ],
    )


def _values(results: Results, candidate: Candidate) -> dict[str, tuple[FloatArray, str]]:
    """Values of the tiles and what they are, by the name of the choice."""
    stiffness, rest = candidate.model.stiffness, rest_offsets(results, candidate)
    values = {
        f"stiffness {axis} [N/m]": (stiffness[:, i], f"stiffness along {axis} of {{S}} [N/m]")
        for i, axis in enumerate(_AXES)
    }
    values |= {
        f"rest position {axis} [mm]": (rest[:, i], f"rest position along {axis} of {{S}} [mm]")
        for i, axis in enumerate(_AXES)
    }
    if candidate.model.variant == "stiffness_bias":
        bias = np.full_like(stiffness, np.nan)
        for cluster, force in candidate.model.force_bias.items():
            bias[candidate.model.cluster_points[cluster]] = force
        for i, channel in enumerate(LOCAL_CHANNELS):
            unit = f"offset {channel} in the cluster's frame [N]"
            values[f"offset {channel} [N]"] = (bias[:, i], unit)
    return values


def _select(name: str, title: str, choices: list[str]) -> str:
    options = "".join(f"<option>{html.escape(choice)}</option>" for choice in choices)
    return f'<label>{html.escape(title)} <select id="{name}">{options}</select></label>'


def _json(document: dict[str, list[bool]]) -> str:
    """JSON that cannot end the script it stands in."""
    return json.dumps(document, separators=(",", ":")).replace("<", "\\u003c")
