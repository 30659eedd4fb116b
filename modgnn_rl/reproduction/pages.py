"""The page of a study: its tables and figures."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import OmegaConf

from modgnn_rl.configs.schema import ReproduceConfig
from modgnn_rl.metrics import unit_of
from modgnn_rl.registry import METRICS
from modgnn_rl.reporting.plots import Curve, Estimate, draw_curves, draw_intervals
from modgnn_rl.reporting.report import Details, Figure, Section, gather_provenance, write_report
from modgnn_rl.reporting.table import Table, as_csv, as_latex, as_markdown
from modgnn_rl.reproduction.claims import claim_tables
from modgnn_rl.reproduction.measurements import VALIDATION, Results
from modgnn_rl.reproduction.paper_tables import format_interval, iqm, name_of, paper_tables, title_of
from modgnn_rl.reproduction.studies import HOPS, PERTURBATIONS, EvalSetting, ModelVariant, perturbation_name
from modgnn_rl.utils.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

__all__ = ["QUESTIONS", "write_study"]

QUESTIONS = {
    "tables": "The paper's tables",
    "communication": "Which kind of communication f_com performs best?",
    "layers": "What is the effect of layers and hops at equal numbers of parameters?",
    "range": "Which model is most robust to another communication range than the {range:g} m of training?",
    "faults": "Which model is most robust to packet loss, delay, noise and dropout?",
    "size": "How does one set of weights, trained with {trained} agents, perform in flocks of other sizes?",
}
STAGES = {
    "cloning": "behaviour cloning of expert episodes, as in the paper",
    "dagger": "cloning, then DAgger",
    "mappo": "cloning, DAgger, then MAPPO",
}


def write_study(results: Results, folder: Path, started: datetime | None = None) -> Path:
    """Write the tables of a study, each as CSV and LaTeX and all on one page, and the report.

    Args:
        results: measurements of the study.
        folder: folder of the reproduction; the study's own folder is inside it.
        started: start time of the command, with a time zone.

    Returns:
        the path of ``report.html``; ``tables.md`` is beside it.
    """
    config, outcome = results.config, results.outcome
    place = folder / (config.study if config.after == "cloning" else f"{config.study}-after-{config.after}")
    place.mkdir(parents=True, exist_ok=True)
    is_paper = config.study == "tables" and config.env.name == ReproduceConfig().env.name
    tables, figures, text = _tabled(results) if is_paper else _studied(results)
    failed = "\n\n".join(f"Failed: {line}." for line in outcome.failure_lines())
    training = {"trained": results.study.trained, "range": getattr(config.env, "comm_range", np.nan)}
    others = {} if is_paper else {"tables": f"Models on the task {config.env.name}"}
    question = {**QUESTIONS, **others}[config.study].format(**training)
    title = f"{question} ({config.scale.name}, {config.seeds} seed{'s' if config.seeds > 1 else ''})"
    about = f"Policies trained by {STAGES[config.after]}. {text}"
    if config.scale.name == "smoke":
        about += " At this scale hardly anything is learned; it only shows that everything runs."
    for name, table in tables.items():
        write_atomically(place / f"{name}.csv", as_csv(table))
        write_atomically(place / f"{name}.tex", as_latex(table))
    page = [f"# {title}", about, failed, *(as_markdown(table) for table in tables.values())]
    write_atomically(place / "tables.md", "\n\n".join(filter(None, page)))
    times = "\n".join(f"{seconds:8.1f} s  {name}" for name, seconds in outcome.seconds.items())
    sections = [
        *([Section("Failed jobs", failed)] if failed else []),
        Section("Results", about, [*figures, *tables.values()]),
        Section("Settings", "", [Details("all settings", _yaml(config)), Details("duration of each job", times)]),
    ]
    spent = {"all jobs": f"{sum(outcome.seconds.values()) / 60:.1f} min on one process"}
    return write_report(place, title, sections, gather_provenance(started=started, times=spent))


def _yaml(config: ReproduceConfig) -> str:
    return OmegaConf.to_yaml(OmegaConf.structured(config))


def _tabled(results: Results) -> tuple[dict[str, Table], list[Figure], str]:
    """The paper's tables and claims."""
    tables = {**claim_tables(results), **paper_tables(results)}
    unit = _in_unit(results)
    unit = _in_unit(results)
    order = ("claims", "margins", "table1", "table2", "table2_iqm", "table3", "comparisons")
    figures = [
        Figure("validation_error", _by_hops(results, VALIDATION), f"Validation error (expert episodes){unit}."),
        Figure("closed_loop_error", _by_hops(results, "N32"), f"Closed-loop error{unit}."),
    ]
    return {name: tables[name] for name in order}, figures, "The paper's values are beside those measured here."


def _in_unit(results: Results) -> str:
    """The unit of the error, after a comma; empty if it has none."""
    unit = unit_of("error", results.config.env.name)
    return f", {unit}" if unit else ""


def _estimate(results: Results, row: ModelVariant | str, setting: str) -> Estimate | None:
    found = iqm(results, row, setting, "error")
    return None if found is None or not np.isfinite(found.high) else Estimate(found.value, found.low, found.high)


def _by_hops(results: Results, setting: str) -> Callable[[Canvas], None]:
    """Draw a row for each model, a marker for each number of hops (and layers), and the references as lines."""
    groups: dict[str, dict[str, Estimate]] = {}
    for variant in results.study.variants:
        layers = "" if variant.layers is None else f"L = {variant.layers}, "
        if (estimate := _estimate(results, variant, setting)) is not None:
            groups.setdefault(f"{layers}K = {variant.hops}", {})[name_of(variant.model)] = estimate
    lines = {name: _estimate(results, name, setting) for name in results.references[1:][-2:]}
    references = {name: line.value for name, line in lines.items() if line is not None}
    label = f"error{_in_unit(results)}"
    return functools.partial(_draw_intervals, groups=groups, references=references, label=label)


def _draw_intervals(
    canvas: Canvas, groups: dict[str, dict[str, Estimate]], references: dict[str, float], label: str
) -> None:
    draw_intervals(canvas, groups, x_label=label, references=references, log_x=True)


def _studied(results: Results) -> tuple[dict[str, Table], list[Figure], str]:
    """Tables of errors and leader-lost rates, a row for each model and a column for each environment; a figure."""
    config, study = results.config, results.study
    name = config.study
    if name in ("communication", "layers"):
        (setting,) = study.settings
        figures = [Figure(name, _by_hops(results, setting.name), f"Closed-loop error{_in_unit(results)}.")]
        settings = {"validation": VALIDATION, "closed loop": setting.name}
    elif name == "tables":
        own = next(setting.name for setting in study.settings if setting.num_agents == study.trained)
        figures = [Figure("closed_loop_error", _by_hops(results, own), f"Closed-loop error{_in_unit(results)}.")]
        settings = {"validation": VALIDATION, **{f"N = {one.num_agents}": one.name for one in study.settings}}
    else:
        figures = (_curves_by_fault if name == "faults" else _curves_by_hops)(results)
        settings = {_heading(setting): setting.name for setting in study.settings}
    usual = next(setting.name for setting in study.settings if _is_usual(results, setting))
    tables = {"errors": _errors(results, "Errors", settings, usual)}
    if name == "faults":
        tables = {f"errors_{fault}": table for fault, table in _errors_by_fault(results, usual)}
    return {**tables, **_rates(results, settings)}, figures, _answer(results, settings, usual)


def _errors_by_fault(results: Results, usual: str) -> Iterator[tuple[str, Table]]:
    """A table for each perturbation, by its setting."""
    for kind, levels in PERTURBATIONS.items():
        settings = {"training setting": usual, **{f"{level:g}": perturbation_name(change) for level, change in levels}}
        yield next(iter(levels[0][1])), _errors(results, f"Errors by {kind}", settings, usual)


def _is_usual(results: Results, setting: EvalSetting) -> bool:
    same = all(getattr(results.config.env, name) == value for name, value in setting.changes.items())
    return same and setting.num_agents == results.study.trained


def _heading(setting: EvalSetting) -> str:
    if setting.name.startswith("size-"):
        return f"N = {setting.num_agents}"
    return ", ".join(f"{name} {value}" for name, value in setting.changes.items()) or "training setting"


def _rows(results: Results) -> list[ModelVariant | str]:
    return [*results.references, *results.study.variants]


def _errors(results: Results, title: str, settings: Mapping[str, str], usual: str) -> Table:
    rises = len(settings) > 2
    body: list[list[str | float]] = []
    for row in _rows(results):
        cells: list[str | float] = [
            format_interval(iqm(results, row, setting, "error")) for setting in settings.values()
        ]
        cells += [_rise(results, row, settings, usual)] if rises else []
        body.append([title_of(row), *cells])
    unit = unit_of("error", results.config.env.name)
    caption = f"Error{f' [{unit}]' if unit else ''}: interquartile mean (IQM) over seeds and episodes"
    caption += " with its 95 % interval."
    if rises:
        caption += " Rise: mean over the other settings, minus the error in the training environment."
    best: dict[int, Any] = dict.fromkeys(range(1, 1 + len(settings) + rises), "low")
    header = ["model", *settings, *(["increase"] if rises else [])]
    return Table(title, header, body, f"{caption} {_episodes(results)}", best, tuple(results.references))


def _rise(results: Results, row: ModelVariant | str, settings: Mapping[str, str], usual: str) -> float:
    found = {setting: iqm(results, row, setting, "error") for setting in dict.fromkeys([*settings.values(), usual])}
    values = {setting: np.nan if interval is None else interval.value for setting, interval in found.items()}
    return float(np.mean([value for setting, value in values.items() if setting != usual]) - values[usual])


def _episodes(results: Results) -> str:
    evaluated = {(setting.flocks, setting.steps) for setting in results.study.settings}
    rollouts = sorted({flocks for flocks, _ in evaluated})
    span = f"{rollouts[0]}" if len(rollouts) == 1 else f"{rollouts[0]} to {rollouts[-1]}"
    return f"{span} episodes of {results.study.settings[0].steps} steps from the same initial states for all rows."


def _rates(results: Results, settings: Mapping[str, str]) -> dict[str, Table]:
    """A table of the task's first metric that is a fraction of episodes, by its name."""
    names = [name for name in results.task.metrics if METRICS[name].options["unit"] == "%"]
    evaluated = {heading: setting for heading, setting in settings.items() if setting != VALIDATION}
    tables = {}
    for name in names[:1]:
        options = METRICS[name].options
        body = []
        for row in _rows(results):
            shares = [results.values(row, setting, name) for setting in evaluated.values()]
            body.append([title_of(row), *("failed" if share is None else f"{share.mean():.0%}" for share in shares)])
        best: dict[int, Any] = dict.fromkeys(range(1, 1 + len(evaluated)), str(options["better"]).removesuffix("er"))
        caption = f"{str(options['about']).partition(' (')[0].capitalize()}."
        title = str(options["title"]).capitalize()
        tables[name] = Table(title, ["model", *evaluated], body, caption, best, tuple(results.references))
    return tables


def _answer(results: Results, settings: Mapping[str, str], usual: str) -> str:
    """The best rows in words."""
    variants = results.study.variants
    errors = {title_of(row): iqm(results, row, usual, "error") for row in variants}
    known = {title: interval.value for title, interval in errors.items() if interval is not None}
    if not known:
        return "No measurement succeeded."
    text = f"Lowest error in the training environment: {min(known, key=known.__getitem__)}."
    rises = {title_of(row): _rise(results, row, settings, usual) for row in variants}
    others = {title: known[title] + rise for title, rise in rises.items() if title in known and np.isfinite(rise)}
    if len(settings) > 2 and others:
        text += f" Lowest mean error in the others: {min(others, key=others.__getitem__)}."
        idle = iqm(results, results.references[-1], usual, "error")
        able = {title: rises[title] for title in others if idle is not None and known[title] < idle.value}
        text += (
            f" Smallest increase among those better than {results.references[-1]}: {min(able, key=able.__getitem__)}."
            if able
            else ""
        )
    return f"{text} ModGNN-MLP's f_com is the Laplacian." if results.config.study == "communication" else text


def _curves_by_hops(results: Results) -> list[Figure]:
    """A figure for each K: errors over the communication range, or over the number of agents."""
    study, is_size = results.study, results.config.study == "size"
    label = "agents" if is_size else "communication range, m"
    at = [
        (setting.num_agents if is_size else setting.changes["comm_range"], setting.name) for setting in study.settings
    ]
    marks = {"trained": float(study.trained) if is_size else float(getattr(results.config.env, "comm_range", 0.0))}
    return [
        Figure(
            f"{results.config.study}_K{hops}",
            functools.partial(
                draw_curves,
                curves=_curves(results, hops, at),
                x_label=label,
                y_label=f"error{_in_unit(results)}",
                marks=marks,
                log_x=is_size,
            ),
            f"Closed-loop error over {label}, K = {hops}; bands are 95 % intervals.",
        )
        for hops in HOPS
    ]


def _curves_by_fault(results: Results) -> list[Figure]:
    """A figure for each perturbation: errors of the models with K = 1 over its strength."""
    figures, usual, label = [], f"study-{results.study.trained}", f"error{_in_unit(results)}"
    for kind, levels in PERTURBATIONS.items():
        at = [(0.0, usual), *((level, perturbation_name(change)) for level, change in levels)]
        draw = functools.partial(draw_curves, curves=_curves(results, 1, at), x_label=kind, y_label=label)
        caption = f"Closed-loop error over {kind}, K = 1; bands are 95 % intervals."
        figures.append(Figure(f"faults_{next(iter(levels[0][1]))}", draw, caption))
    return figures


def _curves(results: Results, hops: int, at: Sequence[tuple[float, str]]) -> dict[str, Curve]:
    """A curve for each model and two references, over levels with the names of their settings."""
    variants = [variant for variant in results.study.variants if variant.hops == hops]
    rows: dict[str, ModelVariant | str] = {name_of(variant.model): variant for variant in variants}
    rows |= {name: name for name in results.references[1:][-2:]}
    curves, unknown = {}, Estimate(np.nan, np.nan, np.nan)
    for name, row in rows.items():
        found = [_estimate(results, row, setting) or unknown for _, setting in at]
        value, low, high = ([getattr(one, end) for one in found] for end in ("value", "low", "high"))
        curves[name] = Curve([level for level, _ in at], value, low, high)
    return curves
