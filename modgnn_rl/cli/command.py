"""What every ``python -m modgnn_rl.<command>`` shares: configuration, help, error messages and exit codes.

A command is a function of one dataclass::

    def main(config: TrainConfig) -> None:
        \"\"\"Train a flock.\"\"\"
        from modgnn_rl.experiment.training import train  # a heavy import, only now: errors in settings come first

        train(config)


    if __name__ == "__main__":
        run_command(main, TrainConfig, "train")

Hydra composes the configuration from ``configs/``; it writes nothing and keeps the working directory. An error that the
user can fix is one line on stderr and exit code 2; a bug keeps its traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import yaml
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.cli.composition import Command, compose, job_name, known_settings, register, settings_given, validate
from modgnn_rl.cli.messages import explain, print_error
from modgnn_rl.cli.tab import answer_tab
from modgnn_rl.errors import InputError
from modgnn_rl.utils.internals import parse_hydra_flags
from modgnn_rl.utils.signals import Stopped

__all__ = ["run_command", "settings_given"]

Config = TypeVar("Config")

INPUT_ERROR = 2
INTERRUPTED = 130
PIPE_CLOSED = 141  # as shells report a program ended by SIGPIPE

# Settings of what Hydra writes.
WITHOUT_EFFECT = ("hydra.run.", "hydra.sweep.", "hydra.output_subdir", "hydra.job.chdir")
# What Hydra raises for a command line or a YAML file that the user can fix, as long as no job has started.
USER_ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError, OSError, UserWarning, ValueError)


def run_command(
    main: Callable[[Config], int | None],
    schema: type[Config],
    name: str,
    *,
    config_path: str = "pkg://modgnn_rl.configs",
) -> None:
    """Compose the configuration that the command line asks for and call ``main`` with it.

    The folder behind ``config_path`` holds ``<name>.yaml``, whose defaults list begins with ``<name>_schema``, and one
    folder of YAML files for each group. The choices of a field declared with `modgnn_rl.configs.settings.group` come
    from its registry and need no YAML file.

    Args:
        main: the command; its docstring heads the help, its return value is the exit code (``None`` counts as 0).
        schema: dataclass of all settings, declared with `modgnn_rl.configs.settings.setting`.
        name: name of the command and of its YAML file.
        config_path: where Hydra looks for the YAML files.

    Raises:
        SystemExit: with code 2 after an error that the user can fix, 130 after Ctrl-C, 143 after SIGTERM, 141 when the
            reader of the output has closed it, as in ``| head``, or the code of ``main``. In a multirun a failing job
            does not stop the others; the code is then the highest.
    """
    # Hydra's own error messages run over several lines; with this set it raises the exception instead.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    command = Command(main, schema, name, config_path)
    flags = _parse_flags(sys.argv[1:])
    jobs = Jobs(command, keep_going=flags.multirun)
    with tempfile.TemporaryDirectory(prefix="modgnn_rl-") as scratch, _exit_codes(command, jobs):
        typed = [os.environ.get("COMP_LINE", "")] if flags.shell_completion else flags.overrides
        own_files = flags.config_dir or any(argument.startswith("hydra.searchpath") for argument in typed)
        register(command, typed, load_all=bool(own_files), scratch=scratch, config_dir=flags.config_dir)
        if flags.shell_completion:
            answer_tab(functools.partial(compose, command, jobs.run), flags.overrides, schema)
        else:
            # All jobs of a multirun are checked before the first starts, unless the user chooses a launcher or sweeper.
            if flags.multirun and not any(override.startswith("hydra/") for override in flags.overrides):
                compose(command, jobs.check)
            compose(command, jobs.run)
        sys.stdout.flush()  # a closed pipe must show here, not when Python exits
    jobs.exit()


class Jobs:
    """Runs the jobs of one call of a command and collects their exit codes.

    Args:
        command: the command.
        keep_going: whether a failing job is reported and the next one starts, as in a multirun.

    Attributes:
        started: whether Hydra has composed a configuration; from then on an exception may be a bug.
    """

    def __init__(self, command: Command, *, keep_going: bool) -> None:
        self.command, self.keep_going = command, keep_going
        self.started = False
        self.codes: list[int] = []
        self.failed: list[str] = []

    def check(self, config: DictConfig) -> None:
        """Check the settings of a job without running it; end the process if they are bad."""
        self.started = True
        try:
            validate(self.command, config)
        except InputError as error:
            print_error(str(error))
            raise SystemExit(INPUT_ERROR) from error

    def run(self, config: DictConfig) -> None:
        """Run a job; end the process if it fails and no others follow."""
        self.started = True
        try:
            self.codes.append(self.command.main(validate(self.command, config)) or 0)
        except Exception as error:
            self.codes.append(self._report(error))
            self.failed.append(job_name())

    def _report(self, error: Exception) -> int:
        """Print what a job failed of and return its exit code, or end the process."""
        if isinstance(error, BrokenPipeError) and _output_is_closed():
            raise SystemExit(PIPE_CLOSED) from error
        if isinstance(error, InputError):
            print_error(str(error))
            if not self.keep_going:
                # Hydra lets SystemExit pass, but prints lines of its own about other exceptions.
                raise SystemExit(INPUT_ERROR) from error
            return INPUT_ERROR
        if not self.keep_going:
            raise error
        traceback.print_exception(error)
        return 1

    def exit(self) -> None:
        """Name the jobs that failed, and end the process with the highest exit code unless all are 0."""
        if self.failed:
            print(f"{len(self.failed)} of {len(self.codes)} jobs failed: {'; '.join(self.failed)}", file=sys.stderr)
        if any(self.codes):
            sys.exit(max(self.codes))


@contextlib.contextmanager
def _exit_codes(command: Command, jobs: Jobs) -> Iterator[None]:
    """End the process with a line and an exit code for what is not a bug."""
    try:
        yield
    except Stopped as stop:
        sys.exit(stop.code)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        if not _output_is_closed():
            raise
        sys.exit(PIPE_CLOSED)
    except USER_ERRORS as error:
        if jobs.started:
            raise
        known = [] if isinstance(error, InputError) else known_settings(command.schema)
        print_error(explain(error, known))
        sys.exit(INPUT_ERROR)


def _output_is_closed() -> bool:
    """Whether it is standard output that cannot be written; if so, Python must not try again when it exits."""
    try:
        print(flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def _parse_flags(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the command line as Hydra will; report an unknown flag in one line, without argparse's usage."""
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            flags = parse_hydra_flags(arguments)
    except SystemExit as stop:
        if not stop.code:
            raise
        reason = output.getvalue().rpartition("error: ")[2].strip()
        print_error(f"{reason}; flags come before or after all settings, and --help lists them")
        sys.exit(INPUT_ERROR)
    for override in flags.overrides:
        if override.lstrip("+~").startswith(WITHOUT_EFFECT):
            name = override.partition("=")[0]
            print_error(f"{name} has no effect, since Hydra writes nothing here; runs= and name= say where a run goes")
            sys.exit(INPUT_ERROR)
    if flags.multirun and "TORCHELASTIC_RUN_ID" in os.environ:
        print_error("--multirun cannot be combined with torchrun: call torchrun once for each run")
        sys.exit(INPUT_ERROR)
    return flags
