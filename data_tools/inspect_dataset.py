"""What is in a dataset, and what looks wrong with it: in the terminal, as JSON, or as a page for the browser."""

import argparse
import json
from pathlib import Path
from typing import Any

from sb3_offline.data_tools.dataset_statistics import inspect_dataset
from sb3_offline.data_tools.joined_datasets import JoinedDatasets

LONGEST_VALUE = 200


def format_summary(summary: dict[str, Any]) -> str:
    """
    :param summary: from ``inspect_dataset``
    :return: a text for the terminal
    """
    lines = [f"{file['file']}  ({file['bytes'] / 1e6:,.1f} MB, {file['storage']})" for file in summary["files"]]
    about = {"environment": f"{summary['env_id'] or '-'} {summary['env_kwargs'] or ''}".rstrip()}
    about |= {"observations": summary["observation_space"], "actions": summary["action_space"]}
    about |= {
        name: f"{array['shape']} {array['dtype']}" for name, array in summary["arrays"].items() if name.startswith("extras/")
    }
    for provenance in summary["provenance"][:1]:
        about |= {name: _shortened(str(value)) for name, value in provenance.items()}
    if len(summary["provenance"]) > 1:
        about["provenance"] = f"the first of {len(summary['provenance'])} that differ"
    lines += [f"  {key:<{max(map(len, about))}}  {value}" for key, value in about.items()]
    counts = f"  {summary['n_episodes']:,} episodes, {summary['n_steps']:,} steps"
    if "lengths" in summary:
        lengths = summary["lengths"]
        counts += f" ({lengths['min']:.0f} to {lengths['max']:.0f} each); "
        counts += f"{summary['terminated']:,} terminated, {summary['truncated']:,} truncated"
        lines += [counts, "", *_group_table(summary["groups"])]
        lines += ["", *_action_table(summary["actions"])]
    else:
        lines += [counts]
    if "examples" in summary:
        lines += ["", f"  {format_examples(summary['examples'])}"]
    warnings = [f"  WARNING {format_warning(warning)}" for warning in summary["warnings"]]
    return "\n".join([*lines, "", *(warnings or ["  no warnings"])])


def format_warning(warning: dict[str, str]) -> str:
    """:return: one line, as ``DatasetError`` words it"""
    return f"{warning['field']}: {warning['problem']}. {warning['remedy']}."


def format_examples(examples: dict[str, Any]) -> str:
    """
    :param examples: ``summary["examples"]``
    :return: one sentence
    """
    text = f"{examples['count']} success examples; {examples['identical']} are among the "
    text += f"{examples['compared_observations']:,} observations that they were compared with, "
    return text + f"{len(examples['far'])} are like none of them"


def _shortened(text: str) -> str:
    return text if len(text) <= LONGEST_VALUE else text[:LONGEST_VALUE] + " ..."


def _group_table(groups: dict[str, dict[str, Any]]) -> list[str]:
    width = max(6, *map(len, groups))
    lines = [
        f"  {'source':<{width}} {'episodes':>9} {'steps':>10} {'success':>8} {'at end':>7} {'mean return (min to max)':>34}"
    ]
    for label, group in groups.items():
        success = f"{group['success']:>8.1%} {group['success_at_end']:>7.1%}" if "success" in group else f"{'-':>8} {'-':>7}"
        spread = group.get("return")
        returns = f"{spread['mean']:.5g} ({spread['min']:.5g} to {spread['max']:.5g})" if spread else "-"
        lines.append(f"  {label:<{width}} {group['episodes']:>9,} {group['steps']:>10,} {success} {returns:>34}")
    return lines


def _action_table(actions: dict[str, Any]) -> list[str]:
    if "counts" in actions:
        return [f"  action {value:<12} {count:>10,} steps" for value, count in actions["counts"].items()]
    lines = [f"  {'action':<8} {'min':>9} {'mean':>9} {'max':>9} {'std':>9} {'saturated':>10}"]
    columns = zip(*(actions[key] for key in ("min", "mean", "max", "std", "saturated")), strict=True)
    for index, (low, mean, high, std, saturated) in enumerate(columns):
        lines.append(f"  {index:<8} {low:>9.3g} {mean:>9.3g} {high:>9.3g} {std:>9.3g} {saturated:>10.1%}")
    return lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """:param parser: gets the options of ``run``"""
    parser.add_argument("dataset", nargs="+", help="dataset files or patterns; several are taken together")
    parser.add_argument("--html", type=Path, metavar="PAGE", help="write a page for the browser too, all in one file")
    parser.add_argument("--examples", help="success examples to compare with the data: folder, .npz, .npy or HDF5 file")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a text")


def run(args: argparse.Namespace) -> None:
    """:param args: what ``add_arguments`` asks for"""
    data = JoinedDatasets(args.dataset)
    summary = inspect_dataset(data, args.examples)
    print(json.dumps(summary, indent=2) if args.json else format_summary(summary))
    if args.html:
        from sb3_offline.data_tools.inspect_page import write_page

        write_page(args.html, data, summary, args.examples)
        if not args.json:
            print(f"\nPage: {args.html}")
