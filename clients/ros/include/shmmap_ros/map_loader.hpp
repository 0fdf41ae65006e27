// SPDX-License-Identifier: Apache-2.0
//
// The node `pointcloud_map_loader` with the daemon's map behind it, as a component.

#ifndef SHMMAP_ROS_MAP_LOADER_HPP
#define SHMMAP_ROS_MAP_LOADER_HPP

#include <memory>
#include <rclcpp/rclcpp.hpp>

namespace shmmap_ros {

/// Serves the daemon's map under the names and with the parameters of Autoware's map loader.
///
/// No callback waits: requests are answered from other threads, so it may share an executor with any node.
class MapLoader : public rclcpp::Node {
 public:
  /// Throws rclcpp::exceptions::InvalidParameterValueException for an impossible value.
  explicit MapLoader(const rclcpp::NodeOptions& options);
  MapLoader(const MapLoader&) = delete;
  MapLoader& operator=(const MapLoader&) = delete;
  /// Ends all threads, within a moment; requests that wait stay without an answer.
  ~MapLoader() override;

 private:
  class Served;
  std::unique_ptr<Served> served_;
};

}  // namespace shmmap_ros

#endif  // SHMMAP_ROS_MAP_LOADER_HPP
