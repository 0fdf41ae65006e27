// SPDX-License-Identifier: Apache-2.0
// What the package shmmap_ros does without rclcpp, a line at a time; words are separated by tabs.
//
//   start ENDPOINT WAIT MAX_WAITING [plain]   requests and the watch of the map begin
//   partial X Y RADIUS, differential X Y RADIUS IDS, selected IDS
//                                     ask; prints the request's number; ids are separated by ";"
//   answer NUMBER                     wait for its answer, and print it as other peers of the tests do
//   answered                          numbers of the requests that have an answer
//   look                              the list of cells, if it has changed since
//   whole LAYER MAX_BYTES             all points as one cloud
//   state, log                        whether the daemon answers, requests waiting, cells left out; lines since
//   stop                              as at the node's end
//
// What is printed ends with a line "done".  With SHMMAP_GENERATED the types are ROS 2's, else they are written out.

#include <chrono>
#include <condition_variable>
#include <iostream>
#include <map>
#include <shmmap_ros/requests.hpp>
#include <shmmap_ros/whole_map.hpp>
#include <sstream>

#ifdef SHMMAP_GENERATED
#include <autoware_map_msgs/srv/get_differential_point_cloud_map.hpp>
#include <autoware_map_msgs/srv/get_partial_point_cloud_map.hpp>
#include <autoware_map_msgs/srv/get_selected_point_cloud_map.hpp>

using Differential = autoware_map_msgs::srv::GetDifferentialPointCloudMap;
using Partial = autoware_map_msgs::srv::GetPartialPointCloudMap;
using Selected = autoware_map_msgs::srv::GetSelectedPointCloudMap;
using Cloud = sensor_msgs::msg::PointCloud2;
#else
#include "autoware_messages.hpp"

using Differential = plain::Service;
using plain::Cloud;
using plain::Partial;
using plain::Selected;
#endif

namespace {

std::mutex mutex;
std::condition_variable news;
std::vector<std::string> lines;              // of the log
std::map<std::size_t, std::string> answers;  // by number
std::size_t asked = 0;
std::unique_ptr<shmmap_ros::Requests> requests;
std::unique_ptr<shmmap_ros::MapWatch> watch;
shmmap::LoaderOptions options;

std::vector<std::string> split(const std::string& text, char at) {
  std::vector<std::string> parts;
  std::stringstream stream(text);
  for (std::string part; std::getline(stream, part, at);) parts.push_back(part);
  return parts;
}

template <typename Message>
void print(std::ostream& to, const char* what, const Message& message) {
  to << what << " " << message.header.stamp.sec << " " << message.header.stamp.nanosec << " "
     << message.header.frame_id << "\n";
}

void print_cloud(std::ostream& to, const Cloud& cloud) {
  print(to, "cloud", cloud);
  to << "shape " << cloud.height << " " << cloud.width << " " << cloud.is_bigendian << " " << cloud.point_step
     << " " << cloud.row_step << " " << cloud.is_dense << "\n";
  for (const auto& field : cloud.fields)
    to << "field " << field.offset << " " << unsigned{field.datatype} << " " << field.count << " " << field.name
       << "\n";
  to << "data " << std::hex;
  for (const unsigned byte : cloud.data) to << (byte >> 4U) << (byte & 15U);
  to << std::dec << "\n";
}

template <typename Response>
std::string text_of(const Response& response) {
  std::stringstream to;
  print(to, "header", response);
  for (const auto& cell : response.new_pointcloud_with_ids) {
    const auto& box = cell.metadata;
    to << std::hexfloat << "cell " << box.min_x << " " << box.min_y << " " << box.max_x << " " << box.max_y << " "
       << std::defaultfloat << cell.cell_id << "\n";
    print_cloud(to, cell.pointcloud);
  }
  if constexpr (shmmap::detail::removes_ids<Response>)
    for (const auto& id : response.ids_to_remove) to << "remove " << id << "\n";
  to << "end\n";
  return to.str();
}

void start(const std::vector<std::string>& words) {
  options.client.endpoint = words.at(1);
  options.client.name = "node";
  options.wait = std::stod(words.at(2));
  options.plain_ids = words.size() > 4;
  const auto into = [](const char* level) {
    return [level](const std::string& line) {
      const std::lock_guard<std::mutex> lock(mutex);
      lines.push_back(level + line);
    };
  };
  requests = std::make_unique<shmmap_ros::Requests>(
      options, shmmap_ros::Log{into("error "), into("warn "), into("info ")}, std::stoul(words.at(3)));
  watch = std::make_unique<shmmap_ros::MapWatch>(options.client, *requests);
}

template <typename Service>
void ask(const std::shared_ptr<typename Service::Request>& request) {
  requests->ask<Service>(request, [number = asked](typename Service::Response& response) {
    auto text = text_of(response);
    const std::lock_guard<std::mutex> lock(mutex);
    answers[number] = std::move(text);
    news.notify_all();
  });
  std::cout << asked++ << "\n";
}

template <typename Service>
std::shared_ptr<typename Service::Request> with_area(const std::vector<std::string>& words) {
  const auto request = std::make_shared<typename Service::Request>();
  request->area.center_x = std::stof(words.at(1));
  request->area.center_y = std::stof(words.at(2));
  request->area.radius = std::stof(words.at(3));
  return request;
}

void print_whole(const std::string& layer, std::size_t max_bytes) {
  shmmap::Client client(options.client);
  try {
    auto cells = client.metadata().cells;
    std::sort(cells.begin(), cells.end(), [](const auto& one, const auto& other) { return one.id < other.id; });
    print_cloud(std::cout, shmmap_ros::whole_cloud<Cloud>(client, cells, layer, 60.0, max_bytes));
  } catch (const shmmap::Error& error) {
    std::cout << error.code() << " " << error.what() << "\n";
  }
}

void obey(const std::vector<std::string>& words) {
  const auto& what = words.at(0);
  if (what == "start") {
    start(words);
  } else if (what == "partial") {
    ask<Partial>(with_area<Partial>(words));
  } else if (what == "differential") {
    auto request = with_area<Differential>(words);
    if (words.size() > 4) request->cached_ids = split(words[4], ';');
    ask<Differential>(request);
  } else if (what == "selected") {
    auto request = std::make_shared<Selected::Request>();
    if (words.size() > 1) request->cell_ids = split(words[1], ';');
    ask<Selected>(request);
  } else if (what == "answer") {
    const auto number = std::stoul(words.at(1));
    std::unique_lock<std::mutex> lock(mutex);
    const bool is_there = news.wait_for(lock, std::chrono::seconds(60), [&] { return answers.count(number) != 0; });
    std::cout << (is_there ? answers[number] : "no answer\n");
  } else if (what == "answered") {
    const std::lock_guard<std::mutex> lock(mutex);
    for (const auto& [number, text] : answers) std::cout << number << "\n";
  } else if (what == "look") {
    if (const auto listing = watch->look())
      for (const auto& cell : listing->cells) std::cout << cell.id << "\n";
  } else if (what == "whole") {
    print_whole(words.at(1), std::stoul(words.at(2)));
  } else if (what == "state") {
    std::cout << requests->is_reachable() << " " << requests->waiting() << " " << requests->left_out() << "\n";
  } else if (what == "log") {
    const std::lock_guard<std::mutex> lock(mutex);
    for (const auto& line : std::exchange(lines, {})) std::cout << line << "\n";
  } else if (what == "stop") {
    requests->stop();
  } else {
    std::cout << "unknown " << what << "\n";
  }
}

}  // namespace

int main() {
  for (std::string line; std::getline(std::cin, line);) {
    obey(split(line, '\t'));
    std::cout << "done" << std::endl;
  }
}
