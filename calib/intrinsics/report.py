"""Report of a calibration: one self-contained HTML page."""

import base64
import html
from collections.abc import Iterator, Sequence
from typing import Final

import cv2
import numpy as np

from groundsbot.calib.camera import parameters_of
from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.intrinsics.calibration import error_map, estimate_of
from groundsbot.calib.intrinsics.model_choice import Calibration

_WIDTH_PX: Final = 560  # of a picture on the page
_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; margin: 2em auto; max-width: 1180px; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.1em; margin: 1.6em 0 .4em; }
.pair { display: flex; flex-wrap: wrap; gap: 2em; } figure { margin: 0; } figcaption { color: #555; max-width: 560px; }
svg { max-width: 100%; height: auto; }
table { border-collapse: collapse; } td, th { padding: .15em .8em .15em 0; text-align: right; font-weight: normal; }
th { color: #555; border-bottom: 1px solid #ccc; }
td:first-child, th:first-child, .words { text-align: left; }
tr.out td { color: #a33; } .bar { display: inline-block; height: .7em; background: #47a; }
"""


def report_html(result: Calibration, sentences: Sequence[str]) -> str:
    """Return the page: verdict, expected prediction errors, corners seen, parameters, and residuals of the views."""
    name = html.escape(result.model.name)
    said = "".join(f"<li>{html.escape(line)}</li>" for line in sentences)
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Calibration of {name}</title>"
        f"<style>{_STYLE}</style></head><body><h1>Calibration of {name}</h1><ul>{said}</ul><div class='pair'>"
        f"{_map_figure(result)}{_views_figure(result)}</div>{_parameters_table(result)}{_views_table(result)}"
        "</body></html>\n"
    )


def _map_figure(result: Calibration) -> str:
    grid, expected = error_map(result)
    height = round(_WIDTH_PX * result.model.height_px / result.model.width_px)
    low, high = float(np.nanmin(expected)), float(np.nanmax(expected))
    share = np.log(np.nan_to_num(expected, nan=high) / low) / max(np.log(high / low), 1e-9)
    coloured = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    large = cv2.resize(coloured, (_WIDTH_PX, height), interpolation=cv2.INTER_CUBIC)
    imaged = np.isfinite(expected)
    large[cv2.resize(imaged.astype(np.uint8), (_WIDTH_PX, height), interpolation=cv2.INTER_NEAREST) == 0] = 128
    encoded = base64.b64encode(cv2.imencode(".png", large)[1].tobytes()).decode()
    outside = "" if imaged.all() else " Grey: the lens has no image there."
    scale = _WIDTH_PX / result.model.width_px
    labels = []
    rows, columns = expected.shape
    for row in np.linspace(0.06, 0.94, 5) * (rows - 1):
        for column in np.linspace(0.04, 0.96, 6) * (columns - 1):
            at = round(float(row)), round(float(column))
            if np.isfinite(expected[at]):
                x, y = (grid.pixels[at] + 0.5) * scale
                labels.append(f"<text x='{x:.0f}' y='{y + 4:.0f}'>{expected[at]:.2g}</text>")
    return (
        f"<figure><svg width='{_WIDTH_PX}' height='{height}' viewBox='0 0 {_WIDTH_PX} {height}' font-size='12' "
        "text-anchor='middle' fill='white' stroke='black' stroke-width='2' paint-order='stroke'>"
        f"<image href='data:image/png;base64,{encoded}' width='{_WIDTH_PX}' height='{height}'/>{''.join(labels)}</svg>"
        f"<figcaption>Expected prediction error in pixels (RMS), after the best rotation: {low:.2g} to {high:.2g}."
        f"{outside}</figcaption></figure>"
    )


def _views_figure(result: Calibration) -> str:
    scale = _WIDTH_PX / result.model.width_px
    height = round(_WIDTH_PX * result.model.height_px / result.model.width_px)
    dots = []
    for index, view in enumerate(result.views):
        colour = "#47a" if result.lens.views[index] else "#c44"
        for x, y in (view.corners.pixels + 0.5) * scale:
            dots.append(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='1.6' fill='{colour}'/>")
    return (
        f"<figure><svg width='{_WIDTH_PX}' height='{height}' viewBox='0 0 {_WIDTH_PX} {height}' "
        f"style='background:#f4f4f0'>{''.join(dots)}</svg>"
        f"<figcaption>Corners seen, in {int(result.lens.views.sum())} views that were used (blue) and "
        f"{int((~result.lens.views).sum())} that were not (red).</figcaption></figure>"
    )


def _parameters_table(result: Calibration) -> str:
    estimate, values = estimate_of(result), parameters_of(result.model)
    rows = "".join(
        f"<tr><td>{name}</td><td>{value:.6g}</td><td>{sigma:.2g}</td></tr>"
        for name, value, sigma in zip(estimate.parameters, values, estimate.sigmas, strict=True)
    )
    scores = ", ".join(f"{kind} {np.sqrt(0.5 * score):.2g} px" for kind, score in result.scores.items())
    tried = f"<p>The simplest model that predicts left-out views well. RMS in left-out views: {scores}.</p>"
    return (
        f"<h2>{result.model.distortion_model}, {result.model.width_px}x{result.model.height_px}</h2>"
        f"{tried if len(result.scores) > 1 else ''}"
        f"<table><tr><th>parameter</th><th>value</th><th>sigma</th></tr>{rows}</table>"
    )


def _views_table(result: Calibration) -> str:
    rows = "".join(_view_rows(result))
    return (
        "<h2>Views</h2><table><tr><th>view</th><th>corners</th><th>of these used</th><th>residual px</th>"
        f"<th>blur px</th><th class='words'>residual, or why it was not used</th></tr>{rows}</table>"
    )


def _view_rows(result: Calibration) -> Iterator[str]:
    lens = result.lens
    number = np.cumsum(lens.views) - 1
    residuals = [lens.fit.residual_px[lens.seen.view == index] for index in range(int(lens.views.sum()))]
    rms = np.array([float(np.sqrt((each**2).mean())) for each in residuals])
    for index, view in enumerate(result.views):
        name, corners = html.escape(view.name), len(view.corners.ids)
        blur = f"{np.median(view.corners.blur_px):.2f}" if corners else ""
        if lens.views[index]:
            own = int(number[index])
            bar = f"<span class='bar' style='width:{_bar_px(rms[own], rms)}px'></span>"
            yield (
                f"<tr><td>{name}</td><td>{corners}</td><td>{len(residuals[own])}</td><td>{rms[own]:.4f}</td>"
                f"<td>{blur}</td><td class='words'>{bar}</td></tr>"
            )
        else:
            why = "too blurred" if result.blurred[index] else "does not agree with the others"
            yield (
                f"<tr class='out'><td>{name}</td><td>{corners}</td><td>0</td><td></td><td>{blur}</td>"
                f"<td class='words'>{why}</td></tr>"
            )


def _bar_px(value: float, values: FloatArray) -> int:
    return round(160 * value / float(values.max()))
