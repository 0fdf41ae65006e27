// SPDX-License-Identifier: Apache-2.0
// Autoware's differential map service out of shared memory, for every RMW: an ordinary node on the machine
// where the daemon runs.  Points are copied into messages once more and travel as any message does; a node
// that is built with `shmmap/autoware.hpp` itself needs neither.
//
//   find_package(autoware_map_msgs REQUIRED)
//   find_package(rclcpp REQUIRED)
//   find_package(shmmap REQUIRED)
//   add_executable(shmmap_map_loader autoware_node.cpp)
//   target_link_libraries(shmmap_map_loader shmmap::shmmap rclcpp::rclcpp ${autoware_map_msgs_TARGETS})
//   install(TARGETS shmmap_map_loader DESTINATION lib/${PROJECT_NAME})
//
//   ros2 run PACKAGE shmmap_map_loader --ros-args -r __ns:=/shmmap -p wait:=10.0
//
// It offers /shmmap/get_differential_pointcloud_map: remap a client's service to it (of the scan matcher, the
// launch argument `client_map_loader`).  In the namespace /map it takes the place of Autoware's own loader,
// for clients that ask for nothing else.  Parameters: `endpoint` (of the daemon; empty: as for every client),
// `wait` (seconds that a try may take).  Without a daemon a request waits until there is one: an empty answer
// would say that nothing has changed.

#include <chrono>
#include <cmath>
#include <cstdint>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <shmmap/autoware.hpp>
#include <string>
#include <thread>
#include <utility>

namespace shmmap_example {

/// A loader for each requester: what one holds, and in which version, says nothing of another.
template <typename Service>
class Requesters {
 public:
  using Loader = shmmap::PcdLoader<Service>;

  /// At most this many are known; beyond that the one with the oldest request is forgotten, and would get
  /// again what it has.
  static constexpr std::size_t most = 256;

  explicit Requesters(shmmap::LoaderOptions options) : options_(std::move(options)) {}

  /// Answer one, when a daemon has; returns false where the program ends before, and there is no answer.
  template <typename Request, typename Response>
  bool answer(const std::string& requester, const Request& request, Response& response) {
    const auto loader = loader_of(requester);
    const auto& area = request.area;
    if (!(area.radius >= 0.0F) || !std::isfinite(area.center_x + area.center_y + area.radius)) {
      response.header.frame_id = "map";  // as Autoware's loader: in no area there is nothing
      return true;
    }
    while (true) {
      if (auto found = loader(&request)) {
        response = std::move(*found);
        return true;
      }
      for (int tenths = 0; tenths < 10; ++tenths) {
        if (options_.keep_waiting && !options_.keep_waiting()) return false;
        std::this_thread::sleep_for(std::chrono::milliseconds(100));
      }
    }
  }

  [[nodiscard]] std::size_t size() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return known_.size();
  }

 private:
  Loader loader_of(const std::string& requester) {  // a copy shares what the loader knows
    const std::lock_guard<std::mutex> lock(mutex_);
    for (auto one = known_.begin(); one != known_.end(); ++one) {
      if (one->first != requester) continue;
      known_.splice(known_.begin(), known_, one);
      return one->second;
    }
    if (known_.size() == most) known_.pop_back();
    return known_.emplace_front(requester, Loader(options_)).second;
  }

  const shmmap::LoaderOptions options_;
  mutable std::mutex mutex_;
  std::list<std::pair<std::string, Loader>> known_;  // the latest request first
};

/// The name of a requester: the bytes of its writer's id.
template <typename RequestId>
std::string requester_of(const RequestId& id) {
  return {reinterpret_cast<const char*>(&id.writer_guid[0]), sizeof id.writer_guid};
}

}  // namespace shmmap_example

#ifndef SHMMAP_WITHOUT_RCLCPP

#include <autoware_map_msgs/srv/get_differential_point_cloud_map.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp/version.h>

namespace shmmap_example {

class MapLoaderNode : public rclcpp::Node {
 public:
  using Service = autoware_map_msgs::srv::GetDifferentialPointCloudMap;

  MapLoaderNode() : Node("pointcloud_map_loader"), requesters_(options()) {
    // a requester whose cells are still being loaded must not hold up the others
    group_ = create_callback_group(rclcpp::CallbackGroupType::Reentrant);
#if RCLCPP_VERSION_GTE(28, 0, 0)  // Jazzy
    const rclcpp::QoS qos = rclcpp::ServicesQoS();
#else
    const rmw_qos_profile_t qos = rclcpp::ServicesQoS().get_rmw_qos_profile();
#endif
    service_ = create_service<Service>(
        "get_differential_pointcloud_map",
        [this](std::shared_ptr<rclcpp::Service<Service>> service, std::shared_ptr<rmw_request_id_t> id,
               std::shared_ptr<Service::Request> request) {
          Service::Response response;
          if (requesters_.answer(requester_of(*id), *request, response)) service->send_response(*id, response);
        },
        qos, group_);
  }

 private:
  shmmap::LoaderOptions options() {
    shmmap::LoaderOptions found;
    found.client.endpoint = declare_parameter<std::string>("endpoint", "");
    found.client.name = get_fully_qualified_name();
    found.wait = declare_parameter<double>("wait", 10.0);
    found.keep_waiting = [] { return rclcpp::ok(); };
    found.log = [this](const std::string& message) { RCLCPP_WARN(get_logger(), "%s", message.c_str()); };
    return found;
  }

  Requesters<Service> requesters_;
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::Service<Service>::SharedPtr service_;
};

}  // namespace shmmap_example

int main(int count, char** words) {
  rclcpp::init(count, words);
  // requests wait for cells and for a daemon: each takes a thread meanwhile
  rclcpp::executors::MultiThreadedExecutor executor(rclcpp::ExecutorOptions(), 8);
  const auto node = std::make_shared<shmmap_example::MapLoaderNode>();
  executor.add_node(node);
  executor.spin();
  rclcpp::shutdown();
}

#endif  // SHMMAP_WITHOUT_RCLCPP
