"""Write the report: one Markdown file about the CSV files and the runs of grids."""

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

from sb3_offline.data.files import replacing
from sb3_offline.report import figures
from sb3_offline.report.aggregates import REPETITIONS, improvement_probabilities, interquartile_means
from sb3_offline.report.episodes import PlayedEpisode, play_finals
from sb3_offline.report.results import FAILED, Results, comparison_table, read_results, with_early_checkpoints


def write_report(
    tables: Sequence[Path],
    output: Path,
    runs: Sequence[Path] = (),
    reference: str = "ceborl",
    notes: Path | None = None,
    *,
    trust: bool = False,
) -> Iterator[str]:
    """
    Write ``report.md`` and its figures.

    :param tables: CSV files of ``sb3-offline benchmark``
    :param output: folder for the report
    :param runs: folder of the runs of each table, for film strips and values (default: leave these out)
    :param reference: the method that others are compared with
    :param notes: a Markdown file to begin with, about anything that numbers cannot show, such as the choice of hyperparameters
    :param trust: open models of these runs that may run any code
    :return: messages for the user, as they arise
    """
    if runs and len(runs) != len(tables):
        raise RuntimeError(
            f"There are {len(tables)} tables and {len(runs)} folders of runs; give one folder for each table, or none"
        )
    names = [table.stem for table in tables]
    if len({*names}) < len(names):
        raise RuntimeError(f"{', '.join(map(str, tables))}: figures are named after tables; rename those of the same name")
    contents = [read_results(table) for table in tables]
    if not any(reference in results.methods for results in contents):
        raise RuntimeError(f"{', '.join(map(str, tables))}: there is no method {reference!r} to compare with (--reference)")
    parts = ["# Report", *([notes.read_text().strip()] if notes else [])]
    output.mkdir(parents=True, exist_ok=True)
    for table, results, folder in zip_longest(tables, contents, runs):
        yield f"{table}: {len(results.entries)} entries"
        parts += _section(results, output, reference)
        figures.plot_curves(with_early_checkpoints(results, table), output / f"{results.name}_curves.png")
        if folder is not None:
            yield f"Playing the final policies in {folder}"
            parts += _episodes(results, folder, output, trust)
    with replacing(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    yield f"Report: {output / 'report.md'}"


def _section(results: Results, output: Path, reference: str) -> list[str]:
    figures.plot_table(results, output / f"{results.name}.png")
    steps = sorted({int(row["step"]) for row in results.rows})
    return [
        f"## {results.name}",
        f"Success rates of the checkpoints at steps {', '.join(map(str, steps))}; no checkpoint was selected. Wilson's 95 % "
        "intervals in parentheses treat all episodes as independent, although those of one seed share a policy, so seeds are "
        "more informative. The paper's rates are those of its Table 1: three seeds, 500,000 steps, from images, on its own "
        "data.",
        comparison_table(results),
        _ranking(results),
        *_failures(results),
        f"![Success rates by task, beside the paper's]({results.name}.png)",
        "### Over all tasks",
        _aggregates(results, reference),
        "### Learning curves",
        f"![Success rate at each checkpoint]({results.name}_curves.png)",
    ]


def _ranking(results: Results) -> str:
    paper = results.paper
    order = "; ".join(
        f"{method} {mean:.2f}" + (f" (paper {paper[method, 'all']:.2f})" if (method, "all") in paper else "")
        for method, mean in results.means.items()
    )
    unfinished = [method for method in results.methods if method not in results.means]
    rest = f" Not on all tasks yet: {', '.join(unfinished)}." if unfinished else ""
    return f"By the mean over the tasks: {order or 'none is complete'}.{rest}"


def _failures(results: Results) -> list[str]:
    names = ("method", "task", "seed", "config")
    failed = sorted({tuple(row[name] for name in names) for row in results.rows if FAILED in row["config"]})
    lines = [f"- {method}, {task}, seed {seed}: {config.partition(FAILED)[2][:-1]}" for method, task, seed, config in failed]
    about = "These runs broke off. The checkpoints that they never reached count as failures:"
    return [about, "\n".join(lines)] if failed else []


def _aggregates(results: Results, reference: str) -> str:
    means, better = interquartile_means(results), improvement_probabilities(results, reference)
    lines = ["| method | seeds | interquartile mean |" + f" P({reference} does better) |" * bool(better)]
    lines.append("|---" * (4 if better else 3) + "|")
    for method, mean in means.items():
        line = f"| {method} | {len(results.seeds(method))} | {mean} |"
        lines.append(line + f" {better.get(method, '')} |" * bool(better))
    about = (
        "The interquartile mean is the mean of the middle half of all runs, over tasks and seeds. The probability is that of "
        f"a run of {reference} beating a run of the other method on the same task, averaged over the tasks; ties count half. "
        f"The 95 % intervals in parentheses are from {REPETITIONS} bootstrap samples of the seeds within each task (rliable); "
        "a single seed has none. Methods that have not run on all tasks are left out."
    )
    return "\n".join([*lines, "", about])


def _episodes(results: Results, runs: Path, output: Path, trust: bool) -> list[str]:
    played: dict[tuple[str, str], PlayedEpisode] = {
        (method, task): episode for method, task, episode in play_finals(results, runs, trust=trust)
    }
    if not played:
        raise RuntimeError(f"{runs}: holds no run of {results.name}; name the folder that was given to benchmark as --runs")
    parts = ["### The policies at play", "The first episode, unselected, of the last evaluation of the first seed."]
    for task in results.tasks:
        episodes = {method: played[method, task] for method in results.methods if (method, task) in played}
        if episodes:
            file = f"{results.name}_{task}.jpg"  # a fifth of the size of a PNG
            figures.plot_strips(episodes, task, output / file)
            parts.append(f"![{task}: frames of an episode of each method]({file})")
    if any(episode.values for episode in played.values()):
        file = f"{results.name}_values.png"
        figures.plot_values(played, output / file)
        parts += [
            "### Values along these episodes",
            "The lower value of the critics for each state and action: the probability of success C, or Q. Green episodes "
            "were solved, at the dotted line.",
            f"![Values along the episodes]({file})",
        ]
    return parts
