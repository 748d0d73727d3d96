"""The command `ros2 probe`."""
from argparse import REMAINDER
import sys

from ros2cli.command import CommandExtension

from ros2probe_cli.completion import candidates
from ros2probe_cli.program import execute


def complete(prefix, parsed_args, **_):
    return candidates(parsed_args.arguments or [], prefix)


class ProbeCommand(CommandExtension):
    """Observe robots with ros2probe, without joining their domain."""

    def add_arguments(self, parser, cli_name, *, argv=None):
        self._argv = argv
        # argparse leaves every argument to rp, also -h and an option in the first place.
        parser.prefix_chars = '\0'
        arguments = parser.add_argument('arguments', nargs=REMAINDER)
        arguments.completer = complete

    def main(self, *, parser, args):
        # Versions of argparse differ in which `--` they remove.
        argv = sys.argv[1:] if self._argv is None else self._argv
        return execute(argv[argv.index(self.NAME) + 1:])
