"""The summary of a dataset as a text for the terminal."""

from typing import Any

from sb3_offline.data.errors import printable

LONGEST_VALUE = 200
"""Longer values of the provenance are cut off after this number of characters."""


def format_summary(summary: dict[str, Any]) -> str:
    """
    :param summary: from ``inspect_dataset``
    :return: several lines for the terminal
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
        about["provenance"] = f"the first of {len(summary['provenance'])} different ones"
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
    return printable("\n".join([*lines, "", *(warnings or ["  no warnings"])]))


def format_warning(warning: dict[str, str]) -> str:
    """
    :param warning: one of ``summary["warnings"]``
    :return: one line in the form of a ``DatasetError``
    """
    return f"{warning['field']}: {warning['problem']}. {warning['remedy']}."


def format_examples(examples: dict[str, Any]) -> str:
    """
    :param examples: ``summary["examples"]``
    :return: one sentence
    """
    text = f"{examples['count']} success examples, compared with {examples['compared_observations']:,} observations: "
    return text + f"{examples['identical']} are among them, {len(examples['far'])} are unlike all of them"


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
