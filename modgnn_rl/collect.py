"""``python -m modgnn_rl.collect episodes=1000``: the expert's flights as a dataset to keep."""

from __future__ import annotations

from modgnn_rl.command import run_command
from modgnn_rl.configs.schema import CollectConfig


def main(config: CollectConfig) -> None:
    """Fly the expert and write its flights to a dataset that trainer=bc reads; started again, it goes on."""
    from modgnn_rl.collecting import collect, report

    print(report(collect(config)))


if __name__ == "__main__":
    run_command(main, CollectConfig, "collect")
