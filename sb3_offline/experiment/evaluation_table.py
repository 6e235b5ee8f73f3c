"""The CSV file of a run's evaluations."""

import csv
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_offline.common.callbacks import log_at_once
from sb3_offline.data.files import replacing
from sb3_offline.experiment.evaluation import EVALUATION_SEED, Evaluation, evaluate_success

EVALUATION_FIELDS = ("step", "episodes", "successes", "mean_return")


class EvaluationTable(BaseCallback):
    """
    Evaluates the policy at regular steps and keeps a CSV file with one row for each evaluation. When a saved model continues
    to learn, the rows up to its step stay, so that the model and the table always agree.

    :param path: the CSV file
    :param env_id: registered id of the environment
    :param env_kwargs: keyword arguments of the environment
    :param eval_freq: gradient steps between evaluations
    :param n_episodes: number of episodes in each evaluation
    :param count_from: first step that counts: a table is complete even if evaluations at earlier steps are missing
    :param seeds: seeds of the evaluations in order (default: all evaluations play the same episodes)
    :param verbose: 1 prints each success rate
    """

    def __init__(
        self,
        path: Path,
        env_id: str,
        env_kwargs: dict[str, Any],
        eval_freq: int,
        n_episodes: int,
        count_from: int = 0,
        seeds: Sequence[int] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.path, self.env_id, self.env_kwargs = path, env_id, env_kwargs
        self.eval_freq, self.n_episodes, self.count_from, self.seeds = eval_freq, n_episodes, count_from, seeds

    def rows(self, until: int) -> list[dict[str, str]]:
        """
        :param until: last step to read
        :return: rows of the file up to that step, with the columns :data:`EVALUATION_FIELDS`
        """
        if not self.path.is_file():
            return []
        try:
            with self.path.open(newline="") as file:
                found = list(csv.DictReader(file))
            rows = [row for row in found if int(row["step"]) <= until]
            for row in rows:
                _ = int(row["episodes"]), int(row["successes"]), float(row["mean_return"])
            return rows
        except (ValueError, TypeError, KeyError, csv.Error) as error:
            warnings.warn(f"{self.path}: is damaged ({' '.join(str(error).split())}), so its evaluations count as missing.")
            return []

    def steps(self, until: int) -> list[int]:
        """
        :param until: last step
        :return: the steps up to there that need an evaluation
        """
        return [step for step in range(self.eval_freq, until + 1, self.eval_freq) if step >= self.count_from]

    def counted_rows(self, until: int) -> list[dict[str, str]]:
        """
        :param until: last step to read
        :return: those of :meth:`rows` that count
        """
        return [row for row in self.rows(until) if int(row["step"]) >= self.count_from]

    def is_complete(self, until: int) -> bool:
        """
        :param until: last step to check
        :return: True if the file holds all evaluations up to there that count
        """
        found = [(int(row["step"]), int(row["episodes"])) for row in self.counted_rows(until)]
        return found == [(step, self.n_episodes) for step in self.steps(until)]

    def _on_training_start(self) -> None:
        self._write(self.rows(self.num_timesteps))

    def _on_step(self) -> bool:
        if self.num_timesteps % self.eval_freq == 0:
            rows = self.rows(self.num_timesteps - 1)
            seed = EVALUATION_SEED if self.seeds is None else self.seeds[self.num_timesteps // self.eval_freq - 1]
            result = evaluate_success(self.model, self.env_id, self.env_kwargs, self.n_episodes, seed)
            values = map(str, evaluation_row(self.num_timesteps, result))
            self._write([*rows, dict(zip(EVALUATION_FIELDS, values, strict=True))])
            log_at_once(self, {"eval/success_rate": result.success_rate})
            if self.verbose:
                print(f"step {self.num_timesteps}: {sum(result.successes)} of {self.n_episodes} episodes solved")
        return True

    def _write(self, rows: list[dict[str, str]]) -> None:
        with replacing(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, EVALUATION_FIELDS)
            writer.writeheader()
            writer.writerows(rows)


def evaluation_row(step: int, result: Evaluation) -> tuple[int, int, int, float]:
    """
    :param step: number of gradient steps so far
    :param result: evaluation of the policy at that step
    :return: values of :data:`EVALUATION_FIELDS`
    """
    mean_return = sum(result.returns) / len(result.returns)
    return step, len(result.successes), sum(result.successes), round(mean_return, 3)
