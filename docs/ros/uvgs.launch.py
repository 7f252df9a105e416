"""ros2 launch docs/ros/uvgs.launch.py image:=/camera/image_raw camera:=camera.yaml beacon:=beacon.toml."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

# The paper's parameters: decimation, Gaussian filter, threshold k, structuring element, limits of blobs.
PARAMETERS = {
    "detection": "fast",
    "alpha": "1.0",
    "blur_sigma_px": "1.0",
    "threshold_k": "2.0",
    "element_px": "3",
    "min_area_px2": "3.0",
    "max_area_px2": "4000.0",
    "min_circularity": "0.5",
}


def generate_launch_description() -> LaunchDescription:
    """Start the installed uvgs command as a node; nothing is built."""
    names = ("image", "camera", "beacon")
    command = ["uvgs", "node", "--ros2"]
    for name in names:
        command += [f"--{name}", LaunchConfiguration(name)]
    command.append("--ros-args")
    for name, value in PARAMETERS.items():
        command += ["-p", f"{name}:={value}"]
    return LaunchDescription(
        [*(DeclareLaunchArgument(name) for name in names), ExecuteProcess(cmd=command, output="screen")]
    )
