// SPDX-License-Identifier: Apache-2.0
//
// The node as a program of its own.  Ends with SIGINT or SIGTERM; exit code 0, or 78 if a parameter is wrong.

#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <memory>
#include <shmmap_ros/map_loader.hpp>
#include <vector>

int main(int count, char** words) {
  for (const int number : {SIGINT, SIGTERM}) std::signal(number, [](int) { std::_Exit(0); });  // until ROS has its own
  try {
    rclcpp::init(count, words);
    // as the node's own, too: else its names for those that are not remapped would come first
    const auto options = rclcpp::NodeOptions().arguments({words, words + count});
    rclcpp::executors::SingleThreadedExecutor executor;
    const auto node = std::make_shared<shmmap_ros::MapLoader>(options);
    executor.add_node(node);
    executor.spin();
  } catch (const rclcpp::exceptions::InvalidParameterValueException& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 78;
  } catch (const std::exception& error) {
    if (!rclcpp::ok()) return 0;  // a signal at its start
    std::fprintf(stderr, "%s\n", error.what());
    return 71;
  }
  rclcpp::shutdown();
}
