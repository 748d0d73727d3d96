"""Completes arguments of rp with its own script for bash, and with names that an agent knows."""
import subprocess

from ros2probe_cli.program import find

SCRIPT = """
. /dev/stdin
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
_rp rp "${@: -1}" "${@: -2:1}"
printf '%s\\n' "${COMPREPLY[@]}"
"""
# Commands whose verbs take names, which the verb `list` prints.
NOUNS = ('topic', 'node', 'service', 'action')


def candidates(words, current):
    """Return what may replace the word `current`, which follows the arguments `words`."""
    program = find()
    if program is None:
        return []
    script = _output([program, 'completions', 'bash'])
    bash = ['bash', '--norc', '-c', SCRIPT, 'bash', 'rp', *words, current]
    found = _output(bash, script).split()
    if len(words) > 1 and words[0] in NOUNS and not current.startswith('-'):
        found += _output([program, words[0], 'list']).splitlines()
    return [candidate for candidate in found if candidate.startswith(current)]


def _output(command, text=''):
    result = subprocess.run(command, input=text, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                            universal_newlines=True)
    return result.stdout
