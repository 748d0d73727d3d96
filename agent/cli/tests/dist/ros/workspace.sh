#!/usr/bin/env bash
# Builds the packages for ROS with colcon, as a user does from the archive of a release.
#
#   workspace.sh RP DIRECTORY   leave DIRECTORY/install, from a wheel of the binary RP
#
# Needs ament_cmake, and colcon in target/tools/ros.
set -euo pipefail
rp=$(realpath "$1") directory=$(realpath "$2")
cd "$(dirname "$0")/../../../../.."
export SOURCE_DATE_EPOCH=1700000000
colcon=$PWD/target/tools/ros/bin/colcon

strip -o "$directory/rp" "$rp"
packaging/build.sh "$(dpkg --print-architecture)" "$directory/rp" "$directory" --compress-type=gz --fast >/dev/null
packaging/wheel.py "$directory"/ros2probe_*.deb "$directory" >/dev/null
packaging/ros.sh "$directory"
rm "$directory"/rp "$directory"/*.deb
tar --extract --directory "$directory" --file "$directory"/ros2probe-*-ros.tar.gz
cd "$directory"
export COLCON_HOME=$directory/colcon
"$colcon" --log-base log build --base-paths ros2probe-*/ --cmake-args \
    "-DROS2PROBE_DOWNLOADS=file://$directory" -DPython3_EXECUTABLE=/usr/bin/python3 >build.log 2>&1 ||
    { cat build.log >&2; exit 1; }
