// SPDX-License-Identifier: Apache-2.0
// The part of the example `autoware_node.cpp` that needs no rclcpp: several requesters of one service.
// Usage: requesters X Y RADIUS COUNT [LIFE]
//
// Each of COUNT requesters asks twice at the same time as the others, the second time with the ids that it
// got.  With LIFE the program is over, as ROS says it, when that has been asked so often.

#define SHMMAP_WITHOUT_RCLCPP
#include <atomic>
#include <cstdio>
#include <thread>

#include "../../clients/cpp/examples/autoware_node.cpp"

#ifdef SHMMAP_GENERATED
#include <autoware_map_msgs/srv/get_differential_point_cloud_map.hpp>

using Service = autoware_map_msgs::srv::GetDifferentialPointCloudMap;
#else
#include "autoware_messages.hpp"

using plain::Service;
#endif

namespace {

struct RequestId {  // as rmw_request_id_t
  std::int8_t writer_guid[16] = {};
  std::int64_t sequence_number = 0;
};

}  // namespace

int main(int count, char** words) {
  if (count < 5) return 2;
  shmmap::LoaderOptions options;
  options.wait = 60.0;
  options.log = [](const std::string& message) { std::fprintf(stderr, "%s\n", message.c_str()); };
  std::atomic<int> life{count > 5 ? std::stoi(words[5]) : 1 << 30};
  options.keep_waiting = [&life] { return --life > 0; };
  shmmap_example::Requesters<Service> requesters(options);
  const int threads = std::stoi(words[4]);
  std::vector<std::string> results(static_cast<std::size_t>(threads));
  std::vector<std::thread> running;
  for (int number = 0; number < threads; ++number) {
    running.emplace_back([&, number] {
      RequestId id;
      id.writer_guid[15] =
          static_cast<std::int8_t>(number / 2);  // two at a time have one name: a loader shared
      const auto name = shmmap_example::requester_of(id);
      Service::Request request;
      request.area.center_x = std::stof(words[1]);
      request.area.center_y = std::stof(words[2]);
      request.area.radius = std::stof(words[3]);
      for (int time = 0; time < 2; ++time) {
        Service::Response response;
        if (!requesters.answer(name, request, response)) {
          results[static_cast<std::size_t>(number)] += "none ";
          continue;
        }
        for (const auto& cell : response.new_pointcloud_with_ids) request.cached_ids.push_back(cell.cell_id);
        results[static_cast<std::size_t>(number)] +=
            std::to_string(response.new_pointcloud_with_ids.size()) + " " + response.header.frame_id + " ";
      }
    });
  }
  for (auto& one : running) one.join();
  for (const auto& one : results) std::printf("%s\n", one.c_str());
  std::printf("%zu\n", requesters.size());
}
