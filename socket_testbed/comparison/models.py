"""Models side by side: settings, errors, offsets and stiffnesses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from socket_testbed.comparison.table import Compared, Comparison, joined, texts_table
from socket_testbed.geometry.regions import Region, all_regions
from socket_testbed.identification.evaluation import summarise_errors
from socket_testbed.identification.model_file import StoredModel
from socket_testbed.samples import LOCAL_CHANNELS, WRENCH_CHANNELS, channel_unit


def compare_models(models: Sequence[StoredModel], names: tuple[str, ...]) -> Comparison:
    """Lay models side by side.

    Args:
        models: The models.
        names: What they are called.
    """
    first = models[0]
    alike = all(model.geometry.same_tiles(first.geometry) for model in models)
    in_tiles = all(stored.model.is_rigid == first.model.is_rigid for stored in models)
    notes = [
        "errors are in-sample, on what each model was fitted to; stiffnesses have no intervals: a"
        " hold determines none of them, see what 'fit' states"
    ]
    if not alike:
        notes.append("the models are of different sockets: they are compared by region alone")
    if not in_tiles:
        notes.append(
            "stiffnesses are along the axes of {S} in the published variants and along those of the"
            " tiles in the rigid ones: they are not compared"
        )
    tables = [texts_table("models", _identities(models), names)]
    tables += [texts_table("settings", _settings(models), names)]
    tables += [part.to_dataframe(names) for part in (*_errors(models), *_offsets(models))]
    mapped = None
    if in_tiles:
        tables += [part.to_dataframe(names) for part in _springs(models, "regions")]
    if in_tiles and alike:
        of_tiles = _springs(models, "tiles")
        tables += [part.to_dataframe(names) for part in of_tiles]
        mapped = of_tiles[-1]  # normal, or along z
    return Comparison(
        kind="models",
        items=names,
        title=f"parameters, settings and errors of {len(models)} models",
        notes=tuple(notes),
        table=joined(tables),
        mapped=mapped,
        geometry=first.geometry,
    )


def _identities(models: Sequence[StoredModel]) -> dict[str, list[str]]:
    return {
        "fitted on": [stored.trial for stored in models],
        "variant": [stored.model.variant for stored in models],
        "samples": [str(stored.samples) for stored in models],
        "status": [stored.status for stored in models],
        "socket": [
            f"{len(stored.geometry)} tiles, {stored.geometry.source or 'no source'}"
            for stored in models
        ],
        "spans without load": [
            ", ".join(f"{start:g}:{end:g}" for start, end in stored.unloaded) or "none"
            for stored in models
        ],
    }


def _settings(models: Sequence[StoredModel]) -> dict[str, list[str]]:
    """The settings that differ; one line where none does."""
    flat = [stored.settings.to_flat() for stored in models]
    texts = {
        name: [str(of_model[name]) for of_model in flat]
        for name in flat[0]
        if any(of_model[name] != flat[0][name] for of_model in flat)
    }
    return texts or {"all settings": ["the same"] * len(models)}


def _errors(models: Sequence[StoredModel]) -> list[Compared]:
    """Errors of the fits on every channel, and their means and medians: in-sample."""
    of_models = [{error.name: error for error in stored.errors} for stored in models]
    units = {name: error.unit for errors in of_models for name, error in errors.items()}
    compared = []
    for field, figure in (("rmse", "RMSE in-sample"), ("skill", "skill in-sample")):
        for name, unit in units.items():
            values = [getattr(errors.get(name), field, np.nan) for errors in of_models]
            title = f"{figure} [{unit if field == 'rmse' else '-'}]"
            compared.append(Compared.plain("errors", [name], title, np.array(values)[:, None]))
    summaries = [summarise_errors(stored.errors) for stored in models]
    for name, title, field in (
        ("mean of the moments", "RMSE in-sample [N m]", "moment_rmse"),
        ("mean of the forces", "RMSE in-sample [N]", "force_rmse"),
        ("median of the local forces", "RMSE in-sample [N]", "local_rmse"),
        ("median of the wrench", "skill in-sample [-]", "wrench_skill"),
        ("median of the local forces", "skill in-sample [-]", "local_skill"),
    ):
        values = [getattr(summary, field) for summary in summaries]
        compared.append(Compared.plain("errors", [name], title, np.array(values)[:, None]))
    return compared


def _offsets(models: Sequence[StoredModel]) -> list[Compared]:
    """Offsets of the wrench and of the clusters, zero in a variant without."""
    compared = []
    wrench = np.array([stored.model.wrench_bias for stored in models])
    for column, channel in enumerate(WRENCH_CHANNELS):
        title = f"offset [{channel_unit(channel)}]"
        values = wrench[:, column : column + 1]
        compared.append(Compared.plain("offsets", [channel], title, values))
    clusters = dict.fromkeys(name for stored in models for name in stored.model.cluster_points)
    for cluster in clusters:
        values = np.array([stored.model.force_bias.get(cluster, np.zeros(3)) for stored in models])
        channels = [f"{cluster}.{channel}" for channel in LOCAL_CHANNELS]
        compared.append(Compared.plain("offsets", channels, "offset [N]", values))
    return compared


def _axes(stored: StoredModel) -> tuple[str, str, str]:
    """What the axes of the stiffnesses are called."""
    return ("axial", "circumferential", "normal") if stored.model.is_rigid else ("x", "y", "z")


def _springs(models: Sequence[StoredModel], part: str) -> list[Compared]:
    """Stiffnesses of regions (sums) or tiles."""
    regions = [
        all_regions(stored.geometry)
        if part == "regions"
        else [Region(n, np.array([i])) for i, n in enumerate(stored.geometry.names)]
        for stored in models
    ]
    sums = [
        {region.name: stored.model.stiffness[region.tiles].sum(axis=0) for region in of_model}
        for stored, of_model in zip(models, regions, strict=True)
    ]
    shared = [name for name in sums[0] if all(name in others for others in sums)]
    values = 1e-3 * np.array([[of_model[name] for name in shared] for of_model in sums])
    return [
        Compared.plain(part, shared, f"{name} stiffness [N/mm]", values[..., axis])
        for axis, name in enumerate(_axes(models[0]))
    ]
