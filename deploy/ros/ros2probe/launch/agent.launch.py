"""Starts the agent of ros2probe as a process of its own, which is no node."""
import os

from ament_index_python.packages import get_package_prefix, get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

PACKAGE = 'ros2probe'
CONFIGURATION = os.path.join(get_package_share_directory(PACKAGE), 'config', 'ros2probe.yaml')
# Each argument is an option of `rp run`. An empty one is left out.
ARGUMENTS = {
    'config': ('Configuration file', CONFIGURATION),
    'watch': ('Also measure this topic or glob', ''),
    'metrics': ('Address and port of the metrics listener, or off, instead of the configured one', ''),
    'api': ('Address and port of the control API, or off, instead of the configured one', ''),
    'foxglove': ('Address and port for viewers, or off, instead of the configured one', ''),
    'replay': ('Observe this capture instead of the host; needs no privilege', ''),
}


def agent(context):
    command = [os.path.join(get_package_prefix(PACKAGE), 'lib', PACKAGE, 'rp'), 'run']
    for name in ARGUMENTS:
        value = LaunchConfiguration(name).perform(context)
        if value:
            command.append(f'--{name}={value}')
    return [ExecuteProcess(cmd=command, output='screen')]


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument(name, description=description, default_value=default)
        for name, (description, default) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=agent)])
