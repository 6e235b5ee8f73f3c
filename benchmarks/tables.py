"""
Write the tables of the README and the docs from the files in results/.

    python benchmarks/tables.py [--check]

A table stands between `<!-- results/NAME.csv -->` (or .json) and `<!-- end -->`; nothing between the two is typed by hand.
"""

import csv
import json
import re
import statistics
import sys
from pathlib import Path
from typing import Any

from scipy.stats import ttest_ind

from sb3_offline.demo.pipeline import result_table
from sb3_offline.report.results import Entry, comparison_table, read_results

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"(<!-- (results/\S+\.(?:csv|json)) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(path: Path) -> str:
    """:return: the file as a Markdown table"""
    if path.suffix == ".json":
        content = json.loads(path.read_text())
        return throughput_table(content) if isinstance(content, list) else card_table(content)
    if path.stem.startswith("table1"):
        return comparison_table(read_results(path))
    with path.open() as file:
        rows = list(csv.DictReader(file))
    if "library" in rows[0]:
        return library_table(rows)
    if "change" in rows[0]:
        return checkpoint_table(rows)
    if "trouble" in rows[0]:
        return chaos_table(rows)
    if "env_step" in rows[0]:
        return online_table(rows)
    if "std_return" in rows[0]:
        return expert_table(rows)
    if "bound_holds" in rows[0]:
        return world_table(rows)
    return rate_table(rows) if "commit" in rows[0] else result_table(rows)


def chaos_table(rows: list[dict[str, str]]) -> str:
    """A row a kind of trouble."""
    lines = ["| What happens | Rounds | Lost | Damaged | |", "|---" * 5 + "|"]
    names = ("rounds", "lost", "damaged")
    cells = [[row["trouble"].capitalize(), *(f"{int(row[name]):,}" for name in names), row["remark"]] for row in rows]
    return "\n".join([*lines, *(f"| {' | '.join(line)} |" for line in cells)])


def card_table(card: dict[str, Any]) -> str:
    """A row a task of a dataset's card, and what holds for all of them."""
    lines = [
        "| task | episodes | successful | in the paper | checkpoints: run, decisions trained (success, weight) |",
        "|---" * 5 + "|",
    ]
    for task, entry in card["tasks"].items():
        mix = (f"{part['run']} {part['step']:,} ({part['success_rate']:.0%}, {part['weight']:.2f})" for part in entry["mix"])
        shares = f"{entry['success_share']:.1%} | {entry['paper_share']:.0%}"
        lines.append(f"| {task} | {entry['episodes']:,} | {shares} | {', '.join(mix)} |")
    sizes = card["bytes_per_decision"]
    facts = {
        "Decisions": f"{card['decisions']:,}",
        "Observations": card["obs_type"],
        "Size": f"{card['bytes'] / 1e6:,.1f} MB",
        "Bytes a decision": f"{sizes['contiguous']:,}, compressed {sizes['compressed']:,}",
        "SHA-256 of actions and scene states": f"`{card['sha256_actions_and_scene_states']}`",
        "Command": f"`{card['command']}`",
        "Time taken": f"{card['seconds'] / 60:.1f} minutes",
        "Versions": ", ".join(f"{name} {version}" for name, version in card["versions"].items()),
    }
    return "\n".join([*lines, "", "| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in facts.items())])


def throughput_table(entries: list[dict[str, Any]]) -> str:
    """Three tables: beside peers, against the floor, and all other costs."""
    lines = ["| | ours, ms | peer | peer, ms | times as fast |", "|---" * 5 + "|"]
    columns = "| | ms | floor, ms | GFLOP a step | GFLOP/s of a product | over the floor | the peer over the floor |"
    floors = [columns, "|---" * 7 + "|"]
    peers_ms = {e["name"].partition("_vs_")[0]: e["peer_ms"] for e in entries if e.get("peer") in ("SB3 SAC", "d3rlpy CQL")}
    others = ["| | ms | |", "|---" * 3 + "|"]
    for entry in entries:
        name, notes = f"`{entry['name']}`", []
        if "peer_ms" in entry:
            low, high = entry.get("ratio_quartiles", [entry["ratio"]] * 2)
            ratio = f"{entry['ratio']:g}" + (f" ({low:g} to {high:g})" if low < high else "")
            lines.append(f"| {name} | {entry['ours_ms']:g} | {entry['peer']} | {entry['peer_ms']:g} | {ratio} |")
        elif "floor_ms" in entry:
            cells = [entry[key] for key in ("ours_ms", "floor_ms", "gflop", "gflop_per_second", "over_floor")]
            learner = entry["name"].removeprefix("floor_").removesuffix("_bf16")
            cells.append(round(peers_ms[learner] / entry["floor_ms"], 2))
            floors.append(f"| {name} | " + " | ".join(f"{cell:g}" for cell in cells) + " |")
        elif entry["name"] == "machine":
            others.append(f"| machine | | {entry['cpu']}, {entry['threads']} threads, torch {entry['torch']} |")
        else:
            notes = [f"{key} {value:,}" for key, value in entry.items() if key not in ("name", "ours_ms", "ours_ms_quartiles")]
            others.append(f"| {name} | {entry.get('ours_ms', '')} | {', '.join(notes)} |")
    return "\n".join([*lines, "", *floors, "", *others])


def world_table(rows: list[dict[str, str]]) -> str:
    """A row a variant of benchmarks/small_world.py."""
    lines = [
        "| variant | learned | true | largest learned / true | states above the bound | bound |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        ratio, share = float(row["largest_ratio"]), float(row["states_above_bound"])
        cells = [row["variant"], row["learned_at_start"], row["true_at_start"], f"{ratio:.4g}", f"{share:.0%}"]
        lines.append(f"| {' | '.join(cells)} | {'holds' if row['bound_holds'] == 'True' else 'broken'} |")
    return "\n".join(lines)


def rate_table(rows: list[dict[str, str]]) -> str:
    """A row a method or variant, a column a task: the mean success rate and, of several seeds, the lowest and the highest."""
    name = "variant" if "variant" in rows[0] else "method"
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    lines = [f"| {name} | " + " | ".join([*tasks, "mean"]) + " |", "|---" * (len(tasks) + 2) + "|"]
    for label in dict.fromkeys(row[name] for row in rows):
        cells, means = [], []
        for task in tasks:
            entry = Entry([row for row in rows if row[name] == label and row["task"] == task])
            if not entry.rows:
                cells.append("")
                continue
            rates = [part.rate for part in entry.by("seed").values()]
            spread = f" ({min(rates):.2f} to {max(rates):.2f})" if len(rates) > 1 else ""
            means.append(entry.rate)
            cells.append(f"{entry.rate:.2f}{spread}" + ", crashed" * entry.failed)
        mean = f"{sum(means) / len(means):.2f}" if len(means) == len(tasks) else ""
        lines.append(f"| {label} | " + " | ".join([*cells, mean]) + " |")
    return "\n".join(lines)


def library_table(rows: list[dict[str, str]]) -> str:
    """
    Two rows an algorithm: mean return at each checkpoint, that of the last three with the standard deviation between seeds,
    and the 95 % interval of the difference between the libraries.
    """
    steps = sorted({int(row["gradient_steps"]) for row in rows})
    header = ["algorithm", "library", "seeds", *(f"step {step}" for step in steps), "last three", "difference"]
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    for algorithm in dict.fromkeys(row["algorithm"] for row in rows):
        cells, counted = [], []
        for library in dict.fromkeys(row["library"] for row in rows):
            own = {
                (row["seed"], int(row["gradient_steps"])): float(row["mean_return"])
                for row in rows
                if (row["algorithm"], row["library"]) == (algorithm, library)
            }
            seeds = list(dict.fromkeys(seed for seed, _ in own))
            curve = [f"{statistics.mean(own[seed, step] for seed in seeds):.0f}" for step in steps]
            counted.append([statistics.mean(own[seed, step] for step in steps[-3:]) for seed in seeds])
            last = f"{statistics.mean(counted[-1]):.0f} ± {statistics.stdev(counted[-1]):.0f}"
            cells.append([algorithm, library, str(len(seeds)), *curve, last])
        ours, theirs = counted
        interval = ttest_ind(ours, theirs, equal_var=False).confidence_interval()
        difference = f"{statistics.mean(ours) - statistics.mean(theirs):+.0f} ({interval.low:+.0f} to {interval.high:+.0f})"
        lines += [f"| {' | '.join([*cells[0], difference])} |", f"| {' | '.join([*cells[1], ''])} |"]
    return "\n".join(lines)


def online_table(rows: list[dict[str, str]]) -> str:
    """A row a method, a column a number of environment steps: the mean return and, of several seeds, the range; the lowest."""
    steps = sorted({int(row["env_step"]) for row in rows})
    shown = steps[::2]
    header = ["method", "seeds", *(f"step {step}" for step in shown), f"lowest after step {steps[0]}"]
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        cells = [method, ", ".join(dict.fromkeys(row["seed"] for row in own))]
        for step in shown:
            returns = [float(row["mean_return"]) for row in own if int(row["env_step"]) == step]
            spread = f" ({min(returns):.0f} to {max(returns):.0f})" if len(returns) > 1 else ""
            cells.append(f"{statistics.mean(returns):.0f}{spread}")
        cells.append(f"{min(float(row['mean_return']) for row in own if int(row['env_step']) > steps[0]):.0f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def expert_table(rows: list[dict[str, str]]) -> str:
    """A row a policy: its return and the standard deviation between its episodes."""
    lines = ["| policy | seed | gradient steps | episodes | return |", "|---" * 5 + "|"]
    for row in rows:
        names = [row["policy"], row["seed"], row["gradient_steps"], row["episodes"]]
        lines.append(f"| {' | '.join(names)} | {float(row['mean_return']):.0f} ± {float(row['std_return']):.0f} |")
    return "\n".join(lines)


def checkpoint_table(rows: list[dict[str, str]]) -> str:
    """A row a variant, a column a checkpoint; seeds are added up."""
    steps = sorted({int(row["step"]) for row in rows})
    lines = ["| variant | change | " + " | ".join(f"step {step}" for step in steps) + " |", "|---" * (2 + len(steps)) + "|"]
    for variant in dict.fromkeys(row["variant"] for row in rows):
        own = [row for row in rows if row["variant"] == variant]
        change, cells = own[0]["change"], []
        for step in steps:
            here = [row for row in own if int(row["step"]) == step]
            solved, episodes = (sum(int(row[name]) for row in here) for name in ("successes", "episodes"))
            cells.append(f"{solved} of {episodes}" if here else "")
        lines.append(f"| {variant} | {f'`{change}`' if change else ''} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def filled(text: str) -> str:
    """:return: the text with all of its tables made anew"""
    return BLOCK.sub(lambda match: f"{match[1]}\n{table(ROOT / match[2])}\n\n{match[3]}", text)


def documents() -> list[Path]:
    """:return: the files that may hold tables"""
    return [ROOT / "README.md", *(path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts)]


def main() -> None:
    stale = [path for path in documents() if filled(path.read_text()) != path.read_text()]
    if "--check" in sys.argv and stale:
        sys.exit(f"tables differ from results/ in {', '.join(str(path.relative_to(ROOT)) for path in stale)}")
    for path in stale:
        path.write_text(filled(path.read_text()))


if __name__ == "__main__":
    main()
