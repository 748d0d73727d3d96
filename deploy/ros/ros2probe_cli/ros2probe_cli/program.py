"""Finds and executes rp. Needs no package of ROS, and creates no node."""
import os
import shutil
import signal


def find():
    """Return the path of rp: in PATH, or else where the package ros2probe installs it."""
    path = os.environ.get('PATH', os.defpath).split(os.pathsep)
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    path += [os.path.join(prefix, 'lib', 'ros2probe') for prefix in prefixes if prefix]
    return shutil.which('rp', path=os.pathsep.join(path))


def execute(arguments):
    """Become rp with these arguments. Return what to install if there is no rp."""
    program = find()
    if program is None:
        distribution = os.environ.get('ROS_DISTRO', '<distribution>')
        return (f'rp is neither in PATH nor in a package ros2probe: '
                f'sudo apt install ros-{distribution}-ros2probe')
    # Python ignores these signals, which a program would inherit.
    for ignored in (signal.SIGPIPE, signal.SIGXFSZ):
        signal.signal(ignored, signal.SIG_DFL)
    os.execv(program, ['rp', *arguments])
