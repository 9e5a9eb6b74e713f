"""Pictures of sweeps. matplotlib is loaded only when one is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from muxjax.collision import World, point_distance
from muxjax.workspace.design import DesignStudy
from muxjax.workspace.result import Sweep

_COLOURS = "viridis"
_INK, _ACCENT, _MUTED = "#1f2933", "#c2410c", "#64748b"


def dexterity_map(sweep: Sweep, path: str | Path) -> Path:
    """Write ``draw_dexterity`` as a picture of its own."""
    figure, axes = _figure(7.2, 5.6)
    draw_dexterity(figure, axes, sweep)
    axes.legend(loc="upper right", frameon=False)
    axes.set_title(f"{_name(sweep)}: dexterity from {sweep.samples:,} samples", loc="left")
    return _save(figure, path)


def draw_dexterity(figure: Any, axes: Any, sweep: Sweep) -> None:
    """The xz plane, coloured by dexterity (as M Fig. 8c); the half plane and its mirror image."""
    table, cells = sweep.half_plane, sweep.cells
    r_mm = 1e3 * cells.r_edges
    x = np.concatenate([-r_mm[:0:-1], r_mm])
    full = np.concatenate([table[::-1], table], axis=0)
    image = axes.pcolormesh(
        x,
        1e3 * cells.z_edges,
        np.ma.masked_invalid(full.T),
        cmap=_COLOURS,
        vmin=0.0,
        rasterized=True,
    )
    bar = figure.colorbar(image, ax=axes, pad=0.02)
    tolerance = sweep.about["tolerance_deg"]
    bar.set_label(f"dexterity: share of orientations met within {tolerance:g}°  [-]")
    axes.plot(0, 0, marker="^", color=_ACCENT, markersize=9, linestyle="none", label="arm root")
    _trim(axes, sweep)
    axes.set_aspect("equal")
    axes.set_xlabel("x  [mm]")
    axes.set_ylabel("z, along the base axis  [mm]")


def clear_map(sweep: Sweep, world: World, path: str | Path) -> Path:
    """Where clear configurations reach, in the xz and the yz plane, with the obstacles' outline.

    Raises:
        ValueError: The sweep had no world, or an odd number of sectors.
    """
    share, cells = sweep.clear_share, sweep.cells
    if cells.n_sectors % 4:
        raise ValueError(f"sectors: must be a multiple of 4 to be drawn, found {cells.n_sectors}")
    figure, panels = _figure(11.5, 5.2, columns=2)
    r_mm, quarter = 1e3 * cells.r_edges, cells.n_sectors // 4
    edges = np.concatenate([-r_mm[:0:-1], r_mm])
    image = None
    for axes, first, name in zip(panels, (0, quarter), "xy", strict=True):
        left = share[first + 2 * quarter]
        full = np.ma.masked_invalid(np.concatenate([left[::-1], share[first]], axis=0).T)
        never = np.ma.masked_where(np.ma.getmaskarray(full) | (full.filled(1) > 0), full)
        image = axes.pcolormesh(
            edges,
            1e3 * cells.z_edges,
            np.ma.masked_where(full.filled(0) == 0, full),
            cmap=_COLOURS,
            vmin=0.0,
            vmax=1.0,
            rasterized=True,
        )
        grey = matplotlib_colours(_MUTED)
        axes.pcolormesh(edges, 1e3 * cells.z_edges, never, cmap=grey, alpha=0.35, rasterized=True)
        _outline(axes, sweep, world, name)
        axes.plot(0, 0, marker="^", color=_ACCENT, markersize=9, linestyle="none")
        _trim(axes, sweep)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{name}, from the arm's root  [mm]")
        axes.set_ylabel("z, along the base axis  [mm]")
    bar = figure.colorbar(image, ax=panels, pad=0.02)
    bar.set_label("share of samples clear of obstacles  [-]; grey: none")
    title = f"{_name(sweep)} in {world.name}: {sweep.samples:,} samples"
    figure.suptitle(title, x=0.04, ha="left")
    return _save(figure, path)


def matplotlib_colours(colour: str) -> Any:
    """A map of one colour."""
    from matplotlib.colors import ListedColormap

    return ListedColormap([colour])


def _outline(axes: Any, sweep: Sweep, world: World, name: str) -> None:
    """Obstacles' surfaces in the plane of the base's z and x or y axis."""
    reach = sweep.cells.reach
    sideways, height = np.meshgrid(np.linspace(-reach, reach, 400), np.linspace(-reach, reach, 400))
    local = np.zeros((*sideways.shape, 3))
    local[..., "xy".index(name)], local[..., 2] = sideways, height
    base = np.asarray(sweep.about["robot"]["base"])
    away = np.asarray(point_distance(world, local @ base[:3, :3].T + base[:3, 3]))
    axes.contourf(1e3 * sideways, 1e3 * height, away, levels=[-1e9, 0.0], colors=[_INK], alpha=0.25)
    axes.contour(1e3 * sideways, 1e3 * height, away, levels=[0.0], colors=[_INK], linewidths=1.2)


def convergence_curve(sweep: Sweep, path: str | Path) -> Path:
    """Mean dexterity against the number of samples, with its extrapolated limit."""
    figure, axes = _figure(7.2, 4.4)
    axes.plot(
        sweep.ladder_samples,
        sweep.mean_ladder,
        marker="o",
        color=_INK,
        label="reached volume's mean",
    )
    limit = sweep.limit()
    if np.isfinite(limit.value):
        low, high = limit.value - limit.uncertainty, limit.value + limit.uncertainty
        axes.axhspan(low, min(high, 1.0), color=_ACCENT, alpha=0.15, linewidth=0)
        axes.axhline(
            limit.value,
            color=_ACCENT,
            linestyle="--",
            label=f"extrapolated limit {limit.value:.3f} ± {limit.uncertainty:.3f}",
        )
    axes.set_xscale("log")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("samples  [-]")
    axes.set_ylabel("mean dexterity  [-]")
    axes.set_title(f"{_name(sweep)}: convergence", loc="left")
    axes.grid(color=_MUTED, alpha=0.25, linewidth=0.6)
    axes.legend(frameon=False)
    return _save(figure, path)


def workspace_cut(sweep: Sweep, path: str | Path) -> Path:
    """The reached volume in 3-D with a quarter cut away; colour is dexterity."""
    figure, _ = _figure(7.2, 6.2, axes=False)
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    points, values, order = _cut_surface(sweep)
    seen = np.argsort(order)
    axes.scatter(
        *(1e3 * points[seen].T), c=values[seen], cmap=_COLOURS, vmin=0.0, s=10, marker="s",
        linewidths=0, depthshade=False,
    )  # fmt: skip
    colours = figure.colorbar(axes.collections[0], ax=axes, shrink=0.7, pad=0.1)
    colours.set_label("dexterity  [-]")
    axes.set_xlabel("x  [mm]")
    axes.set_ylabel("y  [mm]")
    axes.set_zlabel("z  [mm]")
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.set_box_aspect(np.ptp(points, axis=0))
    axes.set_title(f"{_name(sweep)}: reached volume, a quarter cut away", loc="left")
    return _save(figure, path)


def design_plot(study: DesignStudy, path: str | Path) -> Path:
    """Reach and dexterity against the first parameter; a line for each value of the others."""
    rows = study.table()
    first, *others = study.parameters
    figure, axes = _figure(9.6, 4.2, columns=2)
    groups: dict[tuple[float, ...], list[dict[str, float]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in others), []).append(row)
    for key, group in groups.items():
        label = ", ".join(f"{n} = {v:g}" for n, v in zip(others, key, strict=True)) or None
        x = [row[first] for row in group]
        axes[0].plot(x, [1e3 * row["reach_radius_m"] for row in group], marker="o", label=label)
        axes[1].plot(x, [row["mean_dexterity"] for row in group], marker="o", label=label)
    for panel, quantity in zip(axes, ("reach radius  [mm]", "mean dexterity  [-]"), strict=True):
        panel.set_xlabel(first)
        panel.set_ylabel(quantity)
        panel.grid(color=_MUTED, alpha=0.25, linewidth=0.6)
    if others:
        axes[1].legend(frameon=False, fontsize=8)
    figure.suptitle(f"{_name(study.designs[0].sweep)}: design study", x=0.06, ha="left")
    return _save(figure, path)


_ELEVATION, _AZIMUTH = 22.0, -45.0


def _cut_surface(sweep: Sweep) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the outer surface and of the two cut faces, their dexterity, and drawing order."""
    cells, table = sweep.cells, sweep.half_plane
    r = 0.5 * (cells.r_edges[1:] + cells.r_edges[:-1])
    z = 0.5 * (cells.z_edges[1:] + cells.z_edges[:-1])
    reached = np.isfinite(table)
    padded = np.pad(reached, ((0, 1), (1, 1)))
    # A cell is on the surface if its outer, upper or lower neighbour is not reached.
    inside = padded[1:, 1:-1] & padded[:-1, 2:] & padded[:-1, :-2]
    shell = reached & ~inside
    points, values = [], []
    missing = (-np.pi / 2, 0.0)  # the quarter towards the viewer
    for face in missing:
        i, k = np.nonzero(reached)
        points.append(np.stack([r[i] * np.cos(face), r[i] * np.sin(face), z[k]], axis=-1))
        values.append(table[i, k])
    i, k = np.nonzero(shell)
    for azimuth in np.linspace(0.0, 1.5 * np.pi, 271)[1:-1]:
        points.append(np.stack([r[i] * np.cos(azimuth), r[i] * np.sin(azimuth), z[k]], axis=-1))
        values.append(table[i, k])
    place = np.concatenate(points)
    elevation, turn = np.radians(_ELEVATION), np.radians(_AZIMUTH)
    towards = np.array(
        [np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), np.sin(elevation)]
    )
    return place, np.concatenate(values), place @ towards


def _name(sweep: Sweep) -> str:
    return str(sweep.about["robot"]["config"]["name"])


def _trim(axes: Any, sweep: Sweep) -> None:
    """Limits around what is reached, in mm."""
    heights = np.flatnonzero(sweep.reached.any(axis=(0, 1)))
    edges, margin = 1e3 * sweep.cells.z_edges, 40.0
    low = min(edges[heights[0]], 0.0)
    axes.set_ylim(low - margin, edges[heights[-1] + 1] + margin)
    axes.set_xlim(-1e3 * sweep.reach_radius - margin, 1e3 * sweep.reach_radius + margin)


def _figure(width: float, height: float, *, axes: bool = True, columns: int = 1) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns) if axes else None


def _save(figure: Any, path: str | Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=160)
    return path
