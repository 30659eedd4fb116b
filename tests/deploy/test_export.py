"""Exported agents compute what the policy does, need no torch, and are written whole or not at all."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from modgnn_rl import Agent, ModGNN, ModGNNLayer, make_model
from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import DAggerConfig, ExportConfig, ModelConfig, TrainConfig
from modgnn_rl.deploy import export
from modgnn_rl.deploy.agent import EdgeData
from modgnn_rl.deploy.export import Exported, export_agent
from modgnn_rl.deploy.onnx_agent import AgentError, OnnxAgent
from modgnn_rl.errors import InputError
from modgnn_rl.export import main
from modgnn_rl.nn.communication import GraphAttention, MessagePassing
from modgnn_rl.registry import MODELS
from modgnn_rl.tracking.checkpoint import save_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils import folders

ROOT = Path(__file__).parents[2]
NEIGHBOURS = (3, 0, 1, 2, 7, 40, 5)
FEATURES, WIDTH = 6, 4
OWN = {("sensors", "battery"): torch.zeros(1)}
LINKS = EdgeData(weight=True, feature=2)


class _Concatenated(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)

    def forward(self, *parts: Tensor) -> Tensor:
        return self.linear(torch.cat(parts, -1)).tanh()


def keyed(inputs: int, outputs: int, *keys: Any) -> nn.Module:
    return TensorDictModule(_Concatenated(inputs, outputs), in_keys=["data", *keys], out_keys=["data"])


def everything() -> ModGNN:
    """Two layers with own data, weights and features of links, attention, and a maximum."""
    torch.manual_seed(0)
    battery = ("own", "sensors", "battery")
    network = _Concatenated(2 * WIDTH + 1 + LINKS.feature, WIDTH)
    first = ModGNNLayer(
        1,
        keyed(FEATURES + 1, WIDTH, battery),
        MessagePassing(network),
        keyed(WIDTH + FEATURES, 5, ("own", "observation")),
        f_final=nn.Dropout(0.5),
        start="zero",
        aggregation="max",
    )
    attention = GraphAttention(FEATURES + 5, FEATURES + 5)
    second = ModGNNLayer(1, f_com=attention, f_final=keyed(FEATURES + 5 + 1, 3, battery), aggregation="mean")
    return ModGNN([first, second])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    folder, about = tmp_path_factory.mktemp("exports") / "agent", {"model": "everything", "control_frequency": 20.0}
    return export_agent(everything(), folder, torch.zeros(FEATURES), own=OWN, edges=LINKS, **about)  # type: ignore[arg-type]


class Heard:
    """Random steps of one agent of `everything`, and what it is told of its neighbours."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(0)

    def random(self, *shape: int) -> Tensor:
        """Standard normal numbers."""
        return torch.randn(*shape, generator=self.generator)

    def messages(self, count: int, message: Tensor) -> Tensor:
        """Messages of neighbours: one is the agent's own, of others some hops are missing."""
        inbox = self.random(count, *message.shape)
        inbox[torch.rand(inbox.shape[:2], generator=self.generator) < 0.2] = torch.nan
        inbox[1:2] = message
        return inbox


def test_an_exported_agent_is_the_agent(exported: Exported) -> None:
    """The rollout continues over a reboot and over a step at which the agent sees nothing."""
    heard, agent, robot = Heard(), Agent(everything().eval(), LINKS), OnnxAgent(exported.folder)
    program = torch.export.load(exported.folder / "agent.pt2").module()
    for step, count in enumerate(NEIGHBOURS * 2):
        if step == 5:
            agent.reset()
            robot.reset()
        observation, battery = heard.random(FEATURES), heard.random(1)
        if step == 8:
            observation[2] = torch.nan
        message = agent.observe(observation, {("sensors", "battery"): battery})
        sent = robot.observe(observation.numpy(), {"sensors.battery": battery.numpy()})
        close(torch.from_numpy(sent), message)
        inbox, weight, feature = heard.messages(count, message), heard.random(count), heard.random(count, LINKS.feature)
        by_program = program(observation, message, inbox, battery, weight, feature)
        agent.receive(inbox, weight=weight, feature=feature)
        robot.receive(list(inbox.numpy()), weight=weight.tolist(), feature=feature.numpy())
        action = agent.act()
        assert action.isnan().all() == (step == 8)
        close(torch.from_numpy(robot.act()), action)
        close(by_program[0], action)


def close(ours: Tensor, theirs: Tensor, tolerance: float = 1e-5) -> None:
    torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance, equal_nan=True)


@pytest.mark.slow
@pytest.mark.parametrize("hops", [0, 2])
@pytest.mark.parametrize("name", [name for name in MODELS if name != "central"])
def test_every_model_exports(name: str, hops: int, tmp_path: Path) -> None:
    policy = make_model(name, hops, layers=2, seed=0)
    assert export_agent(policy, tmp_path / "agent", torch.zeros(FEATURES)).difference < 1e-6


@pytest.mark.slow
def test_double_precision(tmp_path: Path) -> None:
    layer = ModGNNLayer(2, f_pre=nn.Linear(FEATURES, 3)).double()
    observation = torch.zeros(FEATURES, dtype=torch.float64)
    assert export_agent(ModGNN(layer), tmp_path / "agent", observation).difference < 1e-14
    with pytest.raises(InputError, match=r"onnxruntime cannot run this policy: .* LeakyRelu"):
        export_agent(with_final(nn.LeakyReLU()), tmp_path / "other", observation)


def test_the_description_of_an_exported_agent(exported: Exported) -> None:
    about = json.loads((exported.folder / "agent.json").read_text())
    assert about == exported.metadata == OnnxAgent(exported.folder / "agent.onnx").metadata
    assert about["layers"] == [1, 1]
    assert (about["hops"], about["message_width"]) == (2, FEATURES + 5)
    assert (about["observation_width"], about["action_width"]) == (FEATURES, 3)
    assert (about["dtype"], about["model"], about["control_frequency"]) == ("float32", "everything", 20.0)
    assert about["inputs"]["inbox"] == {"shape": ["neighbours", 2, FEATURES + 5], "dtype": "float32"}
    assert list(about["inputs"]) == ["observation", "messages", "inbox", "own.sensors.battery", "weight", "feature"]
    assert exported.difference < 1e-6


def test_the_files_name_no_folder_of_the_machine_that_made_them(exported: Exported) -> None:
    for name in ("agent.onnx", "agent.pt2", "agent.json"):
        content = (exported.folder / name).read_bytes()
        assert str(ROOT).encode() not in content
        assert b".py" not in content


ALONE = """
import sys
sys.modules["torch"] = sys.modules["modgnn_rl"] = None
import numpy as np
from onnx_agent import OnnxAgent
agent = OnnxAgent(".")
for count in (2, 0):
    message = agent.observe(np.arange(6.0), {"sensors.battery": [0.5]})
    agent.receive([message] * count, weight=[1.0] * count, feature=np.ones((count, 2)))
    action = agent.act()
print(action.tolist())
"""


def test_a_robot_needs_neither_torch_nor_this_library(exported: Exported) -> None:
    command = [sys.executable, "-I", "-c", "import sys; sys.path.insert(0, '.')\n" + ALONE]
    process = subprocess.run(command, cwd=exported.folder, capture_output=True, text=True, timeout=60)
    assert process.stderr == ""
    agent = Agent(everything().eval(), LINKS)
    for count in (2, 0):
        message = agent.observe(torch.arange(6.0), {("sensors", "battery"): torch.tensor([0.5])})
        agent.receive([message] * count, weight=[1.0] * count, feature=torch.ones(count, 2))
        action = agent.act()
    close(torch.tensor(json.loads(process.stdout)), action)


# Damage and misuse.


@pytest.fixture
def copied(exported: Exported, tmp_path: Path) -> Path:
    return shutil.copytree(exported.folder, tmp_path / "agent")


def change(file: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize("position", [0.0, 0.3, 0.6, 0.999])
def test_a_flipped_bit_is_found(copied: Path, position: float) -> None:
    content = bytearray((copied / "agent.onnx").read_bytes())
    content[int(position * len(content))] ^= 1
    (copied / "agent.onnx").write_bytes(content)
    with pytest.raises(AgentError, match=r"agent\.onnx is damaged: its SHA-256 is not the one in agent\.json"):
        OnnxAgent(copied)


def test_other_damage_is_one_sentence_too(copied: Path) -> None:
    about = copied / "agent.json"
    text = about.read_text()
    for damaged in ("", text[:100], "[]", "{}", text.replace("agent.onnx", "agent.onxx")):
        about.write_text(damaged)
        with pytest.raises(AgentError, match=r"agent\.json is damaged"):
            OnnxAgent(copied)
    about.write_text(text)
    change(about, lambda content: content["inputs"]["messages"].update(shape=[3, 11]))
    with pytest.raises(AgentError, match=r"agent\.json does not describe agent\.onnx"):
        OnnxAgent(copied)
    change(about, lambda content: content.update(schema_version=2))
    with pytest.raises(AgentError, match="exported in version 2, this program runs version 1"):
        OnnxAgent(copied)
    about.unlink()
    with pytest.raises(AgentError, match="holds no exported agent"):
        OnnxAgent(copied)
    with pytest.raises(AgentError, match="holds no exported agent"):
        OnnxAgent(copied / "nowhere" / "agent.onnx")


@pytest.mark.parametrize("name", ["agent.onnx", "agent.json"])
@pytest.mark.parametrize("forged", [False, True], ids=["plain", "with its hash"])
def test_a_pickle_is_refused_and_not_run(copied: Path, name: str, forged: bool) -> None:
    mark = copied.parent / "executed"

    class Malicious:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(mark),)

    content = pickle.dumps(Malicious())
    (copied / name).write_bytes(content)
    if forged and name == "agent.onnx":
        change(copied / "agent.json", lambda about: about["files"].update({name: hashlib.sha256(content).hexdigest()}))
    with pytest.raises(AgentError):
        OnnxAgent(copied)
    assert not mark.exists()


SEEN: list[Any] = [np.zeros(FEATURES), {"sensors.battery": [0.0]}]


@pytest.mark.parametrize(
    ("calls", "sentence"),
    [
        ([("receive", [])], "receive was called before observe"),
        ([("act",)], "act was called before observe"),
        ([("observe", *SEEN), ("act",)], r"act was called before receive \(pass \[\]"),
        ([("observe", *SEEN), ("observe", *SEEN)], "observe was called twice"),
        ([("observe", *SEEN), ("receive", []), ("receive", [])], "receive was called twice"),
        ([("observe", *SEEN), ("receive", []), ("act",), ("act",)], "act was called before observe"),
        ([("observe", *SEEN), ("receive", []), ("reset",), ("act",)], "act was called before observe"),
        ([("observe", np.zeros(5), SEEN[1])], r"observation is \[6\], not \[5\]"),
        ([("observe", "far", SEEN[1])], "observation is .* cannot be made of"),
        ([("observe", SEEN[0])], r"reads \['sensors.battery'\] of its own data beside the observation, not \[\]"),
        ([("observe", *SEEN), ("receive", [np.zeros((2, 10))])], r"inbox is \['neighbours', 2, 11\], not \[1, 2, 10\]"),
        ([("observe", *SEEN), ("receive", 5)], r"inbox is \['neighbours', 2, 11\], not \[\]"),
        ([("observe", *SEEN), ("receive", [np.zeros((2, 11))])], "needs an edge weight"),
    ],
)
def test_a_misused_robot_says_so(exported: Exported, calls: list[tuple[Any, ...]], sentence: str) -> None:
    robot = OnnxAgent(exported.folder)
    for name, *arguments in calls[:-1]:
        getattr(robot, name)(*arguments)
    name, *arguments = calls[-1]
    with pytest.raises(AgentError, match=sentence):
        getattr(robot, name)(*arguments)


def test_as_much_must_be_known_of_links_as_there_are_messages(exported: Exported) -> None:
    robot = OnnxAgent(exported.folder)
    robot.observe(*SEEN)
    with pytest.raises(AgentError, match="2 messages came with the weight of 1 edges"):
        robot.receive(np.zeros((2, 2, 11)), weight=[1.0], feature=np.zeros((2, 2)))


# What is refused, and leaves nothing.


class _Remembers(nn.Module):
    """Does something else at each call."""

    calls = 0

    def forward(self, data: Tensor) -> Tensor:
        self.calls += 1
        return data + self.calls


class _Chooses(nn.Module):
    """Looks at data to decide what to do."""

    def forward(self, data: Tensor) -> Tensor:
        return data if data.sum() > 0 else -data


def with_final(f_final: nn.Module) -> ModGNN:
    return ModGNN(ModGNNLayer(0, f_final=f_final))


@pytest.mark.parametrize(
    ("policy", "dtype", "sentence"),
    [
        (with_final(_Remembers()), torch.float32, "differs from the policy by .* more than 1e-05"),
        (with_final(_Chooses()), torch.float32, "a submodule of the policy cannot be exported: "),
        (with_final(nn.Identity()), torch.bfloat16, "float32 or float64, not for observations of torch.bfloat16"),
        (make_model("central", num_agents=3), torch.float32, "only layers of ModGNNLayer can be run agent by agent"),
        (ModGNN(ModGNNLayer(1, start="repeat")), torch.float32, "start='repeat'"),
    ],
)
def test_a_policy_that_cannot_run_alone_is_refused(
    policy: ModGNN, dtype: torch.dtype, sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=sentence):
        export_agent(policy, tmp_path / "agent", torch.zeros(3, dtype=dtype))
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_stays(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("all of it")
    for target in (tmp_path, tmp_path / "thesis.tex"):
        with pytest.raises(InputError, match="is not an exported agent"):
            export_agent(with_final(nn.Identity()), target, torch.zeros(3))
    assert (tmp_path / "thesis.tex").read_text() == "all of it"


def test_folders_of_the_user_beside_an_export_are_kept(tmp_path: Path) -> None:
    for name in ("agent.old", "agent.tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine").write_bytes(b"mine")
    for content in (b"first", b"second"):
        export.write_agent(tmp_path / "agent", {"agent.json": content})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent", "agent.old", "agent.tmp"]
    assert all((tmp_path / name / "mine").read_bytes() == b"mine" for name in ("agent.old", "agent.tmp"))


@pytest.mark.parametrize("broken", ["fsync_file", "fsync_folder"])
def test_a_full_disk_leaves_the_older_export(broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export.write_agent(tmp_path / "agent", {"agent.json": b"old", "agent.onnx": b"old"})

    def full(path: Path) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(folders, broken, full)
        with pytest.raises(InputError, match=r"cannot write .*No space left on device"):
            export.write_agent(tmp_path / "agent", {"agent.json": b"new"})
    assert {file.name: file.read_bytes() for file in (tmp_path / "agent").iterdir()} == {
        "agent.json": b"old",
        "agent.onnx": b"old",
    }
    export.write_agent(tmp_path / "agent", {"agent.json": b"new"})
    assert [file.read_bytes() for file in (tmp_path / "agent").iterdir()] == [b"new"]
    assert [folder.name for folder in tmp_path.iterdir()] == ["agent"]


# The command.


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A run folder as training leaves it, with the policy that it began with."""
    config = TrainConfig(trainer=DAggerConfig(), model=ModelConfig(name="pair_force", hops=2, hidden=8))
    folder = RunFolder.create(tmp_path, "run", OmegaConf.to_yaml(OmegaConf.structured(config)))
    save_checkpoint(folder.checkpoints, 0, {"policy": make_model("pair_force", 2, 8, seed=3).state_dict()}, {})
    return folder


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> object:
    monkeypatch.setattr(sys, "argv", ["export", *arguments])
    try:
        run_command(main, ExportConfig, "export")
    except SystemExit as stop:
        return stop.code
    return 0


@pytest.mark.slow
def test_the_command_exports_what_the_example_runs(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, f"run={run.path}") == 0
    captured = capfd.readouterr()
    for words in (
        f"pair_force, 326 parameters, is in {run.path / 'agent'}",
        "agent.onnx ",
        "agent.pt2 ",
        "Largest difference from the policy: ",
        "One step with 10 neighbours, median: onnxruntime ",
        "There it flies, 48 times a second",
    ):
        assert words in captured.out
    assert captured.err == ""
    assert example().main(run.path, num_agents=5, steps=12) < 1e-5  # runs these files
    assert "5 robots ran for 12 steps" in capfd.readouterr().out


def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("example", ROOT / "examples" / "run_exported_agents.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_extra_is_asked_for(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "onnxruntime" else find_spec(name, *rest)
    )
    assert command(monkeypatch, f"run={run.path}") == 2
    expected = "error: exporting needs onnxruntime, not installed here: pip install 'modgnn-rl[export]'\n"
    assert capsys.readouterr().err == expected
    assert not (run.path / "agent").exists()


def test_a_folder_that_is_no_run_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, f"run={tmp_path}") == 2
    assert "is not a run folder" in capsys.readouterr().err
