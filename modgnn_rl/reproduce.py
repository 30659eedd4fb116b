"""``python -m modgnn_rl.reproduce scale=small``: the paper's evaluation, and the studies beyond it."""

from __future__ import annotations

import sys
from datetime import datetime

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import REFERENCE_SIZE, ReproduceConfig
from modgnn_rl.data.manifest import dataset_env_config
from modgnn_rl.errors import InputError
from modgnn_rl.reproduction.folder import claim_folder


def main(config: ReproduceConfig) -> int:
    """Reproduce the paper's tables beside the published values, or run a study beyond them; re-running resumes.

    Examples::

        python -m modgnn_rl.reproduce scale=smoke
        python -m modgnn_rl.reproduce scale=small
        python -m modgnn_rl.reproduce scale=small study=communication seeds=3
    """
    if config.env.sizes != [REFERENCE_SIZE] or REFERENCE_SIZE not in config.scale.sizes:
        raise InputError(
            f"env.num_agents={config.env.num_agents} must be {REFERENCE_SIZE}, as in the paper's training, and "
            f"scale.sizes={config.scale.sizes} must contain {REFERENCE_SIZE}; add further sizes to scale.sizes"
        )
    dataset_env_config(config.env, config.scale.steps)
    folder = claim_folder(config)
    from modgnn_rl.reproduction.jobs import run_jobs
    from modgnn_rl.reproduction.measurements import Results
    from modgnn_rl.reproduction.pages import write_study
    from modgnn_rl.reproduction.pipeline import jobs_of
    from modgnn_rl.reproduction.studies import study_of
    from modgnn_rl.utils.device import prepare_torch

    prepare_torch(config.device, config.threads)
    study = study_of(config)
    started = datetime.now().astimezone()
    try:
        outcome = run_jobs(folder / "jobs", jobs_of(config, study, folder))
    except KeyboardInterrupt:
        print(f"Stopped; finished jobs are kept in {folder}, and the same command resumes there", file=sys.stderr)
        raise
    page = write_study(Results(outcome, config, study), folder, started)
    print(f"The tables are in {page.with_name('tables.md')}, the report is {page}")
    for line in outcome.failure_lines():
        print(f"failed: {line}", file=sys.stderr)
    if outcome.failures:
        print("Re-running the command repeats the failed jobs only", file=sys.stderr)
    else:
        print(f"Next: python -m webbrowser {page.as_uri()}")
    return 1 if outcome.failures else 0


if __name__ == "__main__":
    run_command(main, ReproduceConfig, "reproduce")
