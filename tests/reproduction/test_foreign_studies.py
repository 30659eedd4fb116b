"""Studies of a task that the library does not know."""

from __future__ import annotations

from typing import Any

import pytest

from modgnn_rl.configs.schema import FlockingConfig, ReproduceConfig, ScaleConfig, TaskConfig
from modgnn_rl.errors import InputError
from modgnn_rl.reproduce import check_request
from modgnn_rl.reproduction.measurements import Results
from modgnn_rl.reproduction.studies import equal_hidden, study_of
from modgnn_rl.task import make_task
from tests.foreign_tasks import GatherConfig


@pytest.mark.parametrize("study", ["tables", "communication", "layers", "size", "range"])
def test_a_study_is_of_the_tasks_own_numbers(study: str) -> None:
    config = ReproduceConfig(env=GatherConfig(num_agents=5), study=study, scale=ScaleConfig(sizes=[3], study_sizes=[4]))
    check_request(config)
    found = study_of(config)
    assert found.trained == 5
    sizes = {"tables": [3, 5], "size": [4, 5]}.get(study, [5])
    assert sorted({setting.num_agents for setting in found.settings}) == sizes
    if study == "range":
        assert [setting.changes["comm_range"] for setting in found.settings] == [0.5, 0.75, 1.0, 1.5, 2.0]


def test_models_of_a_study_have_equal_parameters_on_the_task() -> None:
    task = make_task(GatherConfig())
    wide, narrow = equal_hidden("no_pre", 1, 1), equal_hidden("no_pre", 1, 1, task.layout, task.actions.width)
    assert abs(wide - narrow) <= 3


def test_the_reference_rows_are_the_tasks_own() -> None:
    config = ReproduceConfig(env=GatherConfig())
    outcome: Any = None
    assert Results(outcome, config, study_of(config)).references == ["expert", "zero action"]


@pytest.mark.parametrize(
    ("env", "study", "sentence"),
    [
        (GatherConfig(), "faults", "study=faults varies env.message_loss, a setting that task 'gather' does not have"),
        (FlockingConfig(num_agents=16), "tables", "env.num_agents=16 must be 32, as in the paper's training"),
    ],
)
def test_what_a_task_does_not_allow_is_one_sentence(env: TaskConfig, study: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        check_request(ReproduceConfig(env=env, study=study))
