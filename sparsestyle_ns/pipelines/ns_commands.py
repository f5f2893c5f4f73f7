"""Where nerfstudio's commands on a run begin, as far as the run's config can tell."""

from typing import Any, Callable, Dict

from sparsestyle_ns.pipelines.command_output import claim_output, run_whole, running_command
from sparsestyle_ns.pipelines.export_command import check_export
from sparsestyle_ns.pipelines.render_command import check_numbers
from sparsestyle_ns.utils.errors import InputError, exit_on_input_error


def check_report(command: Any) -> None:
    """InputError where ns-eval would end with an assertion, once all is measured."""
    path = command.output_path
    if path.suffix != ".json":
        raise InputError(
            f"ns-eval writes JSON, and --output-path is {path}; take {path.with_name(path.name + '.json')}."
        )


CHECKS: Dict[str, Callable[[Any], None]] = {"render": check_numbers, "exporter": check_export, "eval": check_report}
"""By nerfstudio's modules of commands."""


@exit_on_input_error
def begin_command() -> None:
    """Called when a config.yml has been read: checks the command that runs, and sees to what it writes."""
    for script, check in CHECKS.items():
        command = running_command(script)
        if command is not None:
            check(command)
            claim_output(command, script)
            run_whole(command, script)
