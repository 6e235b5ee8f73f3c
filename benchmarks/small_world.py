"""
A world small enough that the true probability of future success is known: where do the values of each variant go?

    python benchmarks/small_world.py

writes results/small_world.csv and docs/images/small_world.png (some minutes). Nothing is sampled. The classifier is a table of
logits; its loss is Eq. 10 in expectation over infinite data, put together from the terms of sb3_offline.ceborl.losses, and
minimised until it stands still, while target and policy follow as in CEBORL.train.
"""

import argparse
import csv
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_offline.ceborl import losses

ROOT = Path(__file__).resolve().parent.parent
SIZE, GAMMA, SLIP, CONTINUES, NOISE = 7, 0.9, 0.1, 0.95, 0.2
MOVES = np.array([[0, 1], [0, -1], [1, 0], [-1, 0], [0, 0]])  # the last one stays
CELLS = np.array([[x, y] for x in range(SIZE) for y in range(SIZE)])
CORNERS = np.array([[0, 0], [0, SIZE - 1], [SIZE - 1, 0], [SIZE - 1, SIZE - 1]])
N_STATES, N_ACTIONS = len(CELLS), len(MOVES)
START, GOAL = (SIZE // 2) * SIZE + SIZE // 2, 0
LOGIT_MIN = -20.0


@dataclass(frozen=True)
class World:
    """
    A grid. The data come from five behaviours in equal parts: one heads for each corner with noise, one wanders. The first
    corner is the task. No behaviour stays anywhere but in its corner, so that elsewhere the data never have this action.

    :param transitions: p(s' | s, a), (S, A, S)
    :param success: p(e = 1 | s), (S,)
    :param modes: policy of each behaviour, (M, S, A)
    :param occupancy: of each behaviour, p(s), (M, S)
    """

    transitions: np.ndarray
    success: np.ndarray
    modes: np.ndarray
    occupancy: np.ndarray

    @property
    def data(self) -> np.ndarray:
        """:return: d(s, a), (S, A)"""
        return np.einsum("ms,msa->sa", self.occupancy, self.modes) / len(self.modes)

    @property
    def behavior(self) -> np.ndarray:
        """:return: pi_beta(a | s), (S, A)"""
        return self.data / self.data.sum(axis=1, keepdims=True)

    @property
    def class_share(self) -> float:
        """:return: p(e = 1) in the data"""
        return float(self.data.sum(axis=1) @ self.success)

    def future_success(self, policy: np.ndarray) -> np.ndarray:
        """:return: p^pi(e_{t+} = 1 | s, a), exactly: Q with the reward (1 - gamma) p(e | s), (S, A)"""
        next_state = np.einsum("sax,xb->saxb", self.transitions, policy).reshape(N_STATES * N_ACTIONS, -1)
        reward = np.repeat((1 - GAMMA) * self.success, N_ACTIONS)
        return np.linalg.solve(np.eye(len(reward)) - GAMMA * next_state, reward).reshape(N_STATES, N_ACTIONS)


def make_world() -> World:
    """:return: the world of the page"""
    wanted = np.clip(CELLS[:, None] + MOVES, 0, SIZE - 1) @ (SIZE, 1)
    moves = np.eye(N_STATES)[wanted]
    transitions = (1 - SLIP) * moves + SLIP * moves[:, :4].mean(axis=1, keepdims=True)
    wander = np.tile(np.append(np.full(4, 0.25), 0.0), (N_STATES, 1))
    modes = [wander]
    for corner in CORNERS:
        gain = np.abs(CELLS - corner).sum(axis=1, keepdims=True) - np.abs(CELLS[wanted] - corner).sum(axis=2)
        best = (gain == gain.max(axis=1, keepdims=True)) & ((gain > 0) | (np.arange(N_ACTIONS) == N_ACTIONS - 1))
        modes.append((1 - NOISE) * best / best.sum(axis=1, keepdims=True) + NOISE * wander)
    occupancy = []
    for mode in modes:
        step = np.einsum("sa,sax->sx", mode, transitions)
        occupancy.append((1 - CONTINUES) * np.linalg.solve(np.eye(N_STATES) - CONTINUES * step.T, np.eye(N_STATES)[START]))
    return World(transitions, np.eye(N_STATES)[GOAL], np.stack(modes), np.stack(occupancy))


@dataclass(frozen=True)
class Variant:
    """Arguments of CEBORL, by the same names; and what only this page has. The defaults are the paper's form."""

    name: str
    backup: str = "policy"
    expectile: float = 0.9
    policy_extraction: str = "maximize"
    n_steps: int = 1
    beta: float = 0.1
    mu: str = "uniform"
    penalty_space: str = "probability"
    class_prior: float = 1.0
    example_share: float = 0.0
    initial_odds: float = 1.0
    omega_max: float = 1e4
    temperature: float = 0.3
    advantage_floor: float = 0.01
    weight_max: float = 100.0
    #: a policy that is kept, so that the classifier is all that learns
    fixed_policy: np.ndarray | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Solution:
    """
    :param odds: (S, A), as probabilities: times p(e = 1) in the data, and divided by the class prior
    :param policy: (S, A)
    :param truth: p^pi(e_{t+} = 1 | s, a) of that policy, (S, A)
    :param residual: largest change in a logit by one more step
    """

    odds: np.ndarray
    policy: np.ndarray
    truth: np.ndarray
    residual: float

    def mean(self, values: np.ndarray) -> np.ndarray:
        """:return: E_pi of values (S, A), (S,)"""
        return (self.policy * values).sum(axis=1)


def solve(world: World, variant: Variant, n_iterations: int = 1500, policy_rate: float = 0.02) -> Solution:
    """
    Minimise Eq. 10 over a table of logits, each step with targets and policy of the table before.

    :param world: where
    :param variant: what
    :param n_iterations: steps, each close to Newton's
    :param policy_rate: how far the policy goes towards its optimum in a step
    :return: where it came to rest
    """
    d, d_state = th.tensor(world.data), th.tensor(world.data.sum(axis=1))
    examples = d_state * th.tensor(world.success) / world.class_share  # p(s) of a success example
    successors = _Successors(world, variant)
    logits = th.full((N_STATES, N_ACTIONS), float(np.log(variant.initial_odds)), dtype=th.float64)
    policy = th.tensor(world.behavior if variant.fixed_policy is None else variant.fixed_policy)
    state_logits = logits.mean(dim=1)  # of states alone
    residual = np.inf
    for _ in range(n_iterations):
        odds = losses.success_odds(logits.unsqueeze(0), variant.omega_max)
        omega = successors.discounted_omega(odds, state_logits.exp(), policy)
        shown = examples[:, None] * policy  # p(s, a) of an example with the policy's action
        gradient = eq_10_gradient(variant, logits, d, shown, omega, policy)

        # Newton's step for the logistic terms; the penalty, which is not convex, only makes it shorter
        positives = d * omega + (1 - GAMMA) * variant.class_prior * shown + variant.example_share * GAMMA * odds * shown
        classifier = logits.sigmoid()
        slope = classifier * (1 - classifier)
        steepest = slope if variant.penalty_space == "probability" else th.ones_like(slope)
        curvature = (positives + d + variant.example_share * shown) * slope + variant.beta * d_state[:, None] * steepest
        step = th.where(gradient == 0, 0.0, gradient / curvature.clamp_min(1e-30)).clamp(-0.5, 0.5)
        logits = (logits - step).clamp_min(LOGIT_MIN)
        residual = float((step.abs() * (logits > LOGIT_MIN)).max())
        if variant.backup == "expectile":
            # The mean in which those above count expectile / (1 - expectile) times: where the gradient of its loss is zero
            share = d * th.where(logits > state_logits[:, None], variant.expectile, 1 - variant.expectile)
            state_logits = (share * logits).sum(dim=1) / share.sum(dim=1)
        else:  # the minimum of the same loss as that of pairs: positives over negatives
            state_logits = (positives.sum(dim=1) / (d_state + variant.example_share * examples)).log()
        if variant.fixed_policy is None:
            wanted = _improved_policy(variant, logits, state_logits, policy, th.tensor(world.behavior))
            policy = policy + policy_rate * (wanted - policy)
    scale = world.class_share / variant.class_prior
    return Solution(scale * logits.exp().numpy(), policy.numpy(), world.future_success(policy.numpy()), residual)


def eq_10_gradient(
    variant: Variant, logits: th.Tensor, d: th.Tensor, shown: th.Tensor, omega: th.Tensor, policy: th.Tensor
) -> th.Tensor:
    """
    The gradient of Eq. 10 in expectation: the library's own terms, for each cell of the table as a batch of one.

    :param variant: its weights
    :param logits: the table, (S, A)
    :param d: p(s, a) of the data
    :param shown: p(s, a) of the examples, with the policy's actions
    :param omega: ``gamma * omega`` of each pair, expected over its successors
    :param policy: (S, A)
    :return: (S, A)
    """

    def terms(cell: th.Tensor, cell_omega: th.Tensor, own_omega: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        one = cell.view(1, 1)
        positive = losses.example_loss(one, GAMMA, variant.class_prior)
        if variant.example_share:
            positive = positive + variant.example_share * losses.recursive_loss(one, own_omega.view(1))
        return losses.recursive_loss(one, cell_omega.view(1)), positive

    table = logits.clone().requires_grad_()
    own_omega = GAMMA * losses.success_odds(logits.unsqueeze(0), variant.omega_max)
    of_data, of_examples = th.vmap(th.vmap(terms))(table, omega, own_omega)
    loss = (d * of_data + shown * of_examples).sum()
    if variant.beta:
        # (s, a, sampled): term (a) of the data's action against sampled ones
        pairs = table.unsqueeze(2).expand(-1, -1, N_ACTIONS)
        others = table.unsqueeze(1).expand(-1, N_ACTIONS, -1)
        if variant.mu == "uniform":  # all actions at once: the log-mean-exp of CEBORL as its number of samples grows
            one_state = th.vmap(
                lambda own, row: losses.conservative_penalty(own.view(1, 1), row.view(1, 1, -1), variant.penalty_space)
            )
            loss = loss + variant.beta * (d * th.vmap(one_state)(table, others)).sum()
        else:  # one sample at a time: E_mu[C] as Eq. 9 has it
            one = th.vmap(
                lambda own, other: losses.conservative_penalty(own.view(1, 1), other.view(1, 1, 1), variant.penalty_space)
            )
            weights = d.unsqueeze(2) * policy.unsqueeze(1)
            loss = loss + variant.beta * (weights * th.vmap(th.vmap(one))(pairs, others)).sum()
    return th.autograd.grad(loss, table)[0]


class _Successors:
    """What follows a pair in the data: the expectation of omega over the data's next (and n-th) states and actions."""

    def __init__(self, world: World, variant: Variant):
        self.variant = variant
        joint = world.occupancy[:, :, None] * world.modes
        posterior = joint / np.maximum(joint.sum(axis=0), 1e-300)  # which behaviour it was, (M, S, A)
        steps = np.einsum("msa,sax->msx", world.modes, world.transitions)
        self.horizons = []
        for n in sorted({1, variant.n_steps}):
            ahead = [world.transitions @ np.linalg.matrix_power(step, n - 1) for step in steps]
            states = np.einsum("msa,msax->sax", posterior, ahead)
            pairs = np.einsum("msa,msax,mxb->saxb", posterior, ahead, world.modes)
            self.horizons.append((GAMMA**n, th.tensor(states), th.tensor(pairs)))

    def discounted_omega(self, odds: th.Tensor, state_odds: th.Tensor, policy: th.Tensor) -> th.Tensor:
        """:return: (S, A), the mean over the horizons"""
        parts = []
        for discount, states, pairs in self.horizons:
            if self.variant.backup == "expectile":
                parts.append(discount * th.einsum("sax,x->sa", states, state_odds))
            elif self.variant.backup == "policy":
                parts.append(discount * th.einsum("sax,xb,xb->sa", states, policy, odds))
            else:
                parts.append(discount * th.einsum("saxb,xb->sa", pairs, odds))
        return th.stack(parts).mean(dim=0)


def _improved_policy(
    variant: Variant, logits: th.Tensor, state_logits: th.Tensor, policy: th.Tensor, behavior: th.Tensor
) -> th.Tensor:
    """:return: where the actor's loss has its minimum, (S, A)"""
    if variant.policy_extraction == "maximize":
        best = logits >= logits.max(dim=1, keepdim=True).values - 1e-9
        return best / best.sum(dim=1, keepdim=True)
    success = (policy[GOAL] * logits[GOAL].exp()).sum()
    # Of an action's outcomes, only the classifier's odds are a table: advantage="value"
    weights = losses.odds_ratio_weights(
        logits.exp().flatten(),
        state_logits.repeat_interleave(N_ACTIONS),
        success,
        variant.temperature,
        variant.advantage_floor,
        variant.advantage_floor,
        variant.weight_max,
        exponent=0.0,
    )
    weighted = behavior * weights.view(N_STATES, N_ACTIONS)
    return weighted / weighted.sum(dim=1, keepdim=True)


#: CEBORL with the dataset's next action in omega, and a policy that imitates actions by weight. The default `backup="episode"`
#: cannot be shown here: it needs episodes and not their distribution
IN_SAMPLE = Variant(
    "default",
    backup="dataset",
    policy_extraction="weighted",
    n_steps=10,
    example_share=0.02,
    initial_odds=0.01,
)


def all_variants(world: World) -> dict[str, list[Variant]]:
    """:return: the rows of the table, in series"""
    paper, shipped = Variant("paper's form"), IN_SAMPLE
    known = Variant("fixed policy", beta=0.0, mu="policy", class_prior=world.class_share, fixed_policy=world.modes[1 + GOAL])

    def change(variant: Variant, **changes: Any) -> Variant:
        text = ", ".join(f"{key} = {value}" for key, value in changes.items())
        return replace(variant, name=f"{variant.name}: {text}", **changes)

    return {
        "paper": [
            replace(paper, name="RCE: beta = 0", beta=0.0),
            paper,
            *(change(paper, beta=beta) for beta in (0.01, 1.0, 10.0)),
            change(paper, penalty_space="logit"),
            change(paper, mu="policy"),
            change(paper, initial_odds=0.01),
            change(paper, example_share=0.02),
            change(paper, n_steps=10),
            change(paper, backup="dataset"),
            change(paper, policy_extraction="weighted"),
        ],
        "default": [
            shipped,
            *(change(shipped, beta=beta) for beta in (0.0, 0.01, 1.0, 10.0) if beta != shipped.beta),
            change(shipped, penalty_space="logit"),
            change(shipped, n_steps=1),
            change(shipped, example_share=0.0),
            change(shipped, class_prior=round(world.class_share, 3)),
            change(shipped, backup="policy"),
            change(shipped, backup="expectile"),
            change(shipped, backup="expectile", n_steps=1),
            change(shipped, policy_extraction="maximize"),
        ],
        "fixed policy": [change(known, beta=beta) for beta in (0.0, 0.01, 0.1, 1.0, 10.0)],
    }


def table_row(world: World, series: str, variant: Variant, solution: Solution) -> dict[str, Any]:
    """:return: of the CSV file. The bound is Proposition 1's: E_pi[odds] <= E_pi[p^pi(e_{t+} = 1 | s, a)] in every state"""
    learned, true = solution.mean(solution.odds), solution.mean(solution.truth)
    behavior = (world.behavior * world.future_success(world.behavior)).sum(axis=1)
    ratio = learned / true
    return {
        "series": series,
        "variant": variant.name,
        "beta": variant.beta,
        "learned_at_start": f"{learned[START]:.4f}",
        "true_at_start": f"{true[START]:.4f}",
        "behavior_at_start": f"{behavior[START]:.4f}",
        "largest_ratio": f"{ratio.max():.3f}",
        "states_above_bound": f"{(ratio > 1 + 1e-6).mean():.2f}",
        "bound_holds": bool((ratio <= 1 + 1e-6).all()),
        "residual": f"{solution.residual:.0e}",
    }


def plot(world: World, rows: list[dict[str, Any]], profiles: dict[str, Solution], figure: Path) -> None:
    """The bound against beta; and, for some variants, values by the distance from the goal."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    canvas = plt.figure(figsize=(11, 9), layout="constrained")
    grid = canvas.add_gridspec(3, 4)
    panel = canvas.add_subplot(grid[0, :2])
    panel.imshow(world.data.sum(axis=1).reshape(SIZE, SIZE), cmap="Greys", norm="log")
    for name, cells in {
        "goal of the task": CORNERS[:1],
        "other goals in the data": CORNERS[1:],
        "start": CELLS[[START]],
    }.items():
        panel.scatter(cells[:, 1], cells[:, 0], label=name, s=60)
    panel.set(title="the world: how often the data visit a cell", xticks=[], yticks=[])
    panel.legend(loc="center left", bbox_to_anchor=(1.02, 0.5), fontsize=8)

    panel = canvas.add_subplot(grid[0, 2:])
    for series in dict.fromkeys(row["series"] for row in rows):
        sweep = [row for row in rows if row["series"] == series and is_of_sweep(row["variant"])]
        sweep.sort(key=lambda row: row["beta"])
        panel.plot(
            [max(row["beta"], 1e-3) for row in sweep], [float(row["largest_ratio"]) for row in sweep], "o-", label=series
        )
    panel.axhline(1.0, color="0.3", linestyle="--", linewidth=1)
    panel.set(xscale="log", yscale="log", xlabel="beta (leftmost: 0)", title="largest learned / true; the bound holds below 1")
    panel.legend(fontsize=8)

    distance = np.abs(CELLS - CORNERS[GOAL]).sum(axis=1)
    behavior = (world.behavior * world.future_success(world.behavior)).sum(axis=1)
    for place, (name, solution) in enumerate(profiles.items()):
        panel = canvas.add_subplot(grid[1 + place // 4, place % 4])
        lines = {"learned": solution.mean(solution.odds), "true": solution.mean(solution.truth), "true, of the data": behavior}
        for (label, values), style in zip(lines.items(), ("o-", "--", ":"), strict=True):
            means = [values[distance == steps].mean() for steps in range(distance.max() + 1)]
            panel.plot(means, style, label=label, markersize=3)
        panel.set(yscale="log", ylim=(1e-4, 20), xlabel="steps from the goal")
        panel.set_title(name.replace(": ", ":\n", 1), fontsize=9)
        if place == 0:
            panel.set_ylabel("probability of future success")
            panel.legend(fontsize=8)
    figure.parent.mkdir(parents=True, exist_ok=True)
    canvas.savefig(figure, dpi=110)
    plt.close(canvas)


def is_of_sweep(variant: str) -> bool:
    """:return: whether nothing but beta is changed"""
    return ": " not in variant or ": beta = " in variant


PROFILES = (
    "RCE: beta = 0",
    "paper's form",
    "paper's form: penalty_space = logit",
    "paper's form: backup = dataset",
    "default",
    "default: n_steps = 1",
    "default: backup = policy",
    "default: policy_extraction = maximize",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "results/small_world.csv")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs/images/small_world.png")
    args = parser.parse_args()
    th.set_num_threads(1)

    world = make_world()
    rows, profiles = [], {}
    for series, variants in all_variants(world).items():
        for variant in variants:
            solution = solve(world, variant)
            rows.append(table_row(world, series, variant, solution))
            print(rows[-1])
            if variant.name in PROFILES:
                profiles[variant.name] = solution
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    plot(world, rows, profiles, args.figure)


if __name__ == "__main__":
    main()
