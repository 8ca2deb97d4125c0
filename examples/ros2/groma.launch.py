"""Runs gromad beside the nodes of a robot: ros2 launch groma.launch.py config:=/etc/groma/gromad.yaml"""
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument("config", default_value="/etc/groma/gromad.yaml"),
        ExecuteProcess(cmd=["gromad", "--config", LaunchConfiguration("config")], output="screen", respawn=True),
    ])
