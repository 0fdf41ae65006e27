// SPDX-License-Identifier: Apache-2.0

#include "shmmap_ros/map_loader.hpp"

#include <rclcpp/version.h>

#include <array>
#include <autoware_map_msgs/msg/point_cloud_map_meta_data.hpp>
#include <autoware_map_msgs/srv/get_differential_point_cloud_map.hpp>
#include <autoware_map_msgs/srv/get_partial_point_cloud_map.hpp>
#include <autoware_map_msgs/srv/get_selected_point_cloud_map.hpp>
#include <cmath>
#include <condition_variable>
#include <diagnostic_msgs/msg/diagnostic_array.hpp>
#include <map>
#include <mutex>
#include <rclcpp_components/register_node_macro.hpp>
#include <sensor_msgs/msg/point_cloud2.hpp>
#include <shmmap_ros/requests.hpp>
#include <shmmap_ros/whole_map.hpp>
#include <sstream>
#include <thread>

namespace shmmap_ros {
namespace {

namespace msg = autoware_map_msgs::msg;
namespace srv = autoware_map_msgs::srv;
using Clock = std::chrono::steady_clock;
using Cloud = sensor_msgs::msg::PointCloud2;
using diagnostic_msgs::msg::DiagnosticArray;
using diagnostic_msgs::msg::DiagnosticStatus;
using rclcpp::exceptions::InvalidParameterValueException;

constexpr std::size_t depth = 100;  // of services; with the usual ten, requests at once are lost over Fast DDS
constexpr std::chrono::seconds look{1}, retry{30}, warn{60};

/// Names for those of Autoware's map loader, where nothing else is remapped.
constexpr std::array<const char*, 6> remaps{
    "service/get_partial_pcd_map:=get_partial_pointcloud_map",
    "service/get_differential_pcd_map:=get_differential_pointcloud_map",
    "service/get_selected_pcd_map:=get_selected_pointcloud_map",
    "output/pointcloud_map:=pointcloud_map",
    "output/pointcloud_map_metadata:=pointcloud_map_metadata",
    "output/debug/downsampled_pointcloud_map:=debug/downsampled_pointcloud_map",
};

rclcpp::NodeOptions with_names(rclcpp::NodeOptions options) {
  auto words = options.arguments();
  words.emplace_back("--ros-args");
  for (const char* remap : remaps) words.insert(words.end(), {"-r", remap});  // of several rules the first counts
  return options.arguments(words);
}

std::string text_of(double number) {
  std::ostringstream text;
  text.imbue(std::locale::classic());
  text.precision(17);
  text << number;
  return text.str();
}

}  // namespace

class MapLoader::Served {
 public:
  explicit Served(MapLoader& node)
      : node_(node),
        frame_id_(text("frame_id", "frame of the map; empty: as the daemon says")),
        options_(loader_options()),
        requests_(options_, log()) {
    const auto latched = rclcpp::QoS(1).transient_local();
    metadata_ = node.create_publisher<msg::PointCloudMapMetaData>("output/pointcloud_map_metadata", latched);
    diagnostics_ = node.create_publisher<DiagnosticArray>("/diagnostics", 1);
    if (flag("enable_whole_load", false, "publish all points of the map"))
      wholes_.push_back({"points", node.create_publisher<Cloud>("output/pointcloud_map", latched), 0});
    const double leaf = number("leaf_size", 3.0, 1e-3, "edge of the voxels of the downsampled map, metres");
    if (flag("enable_downsampled_whole_load", false, "publish the map with a point in each voxel of leaf_size"))
      wholes_.push_back({"voxel(leaf=" + text_of(leaf) + ")",
                         node.create_publisher<Cloud>("output/debug/downsampled_pointcloud_map", latched), 0});
    if (flag("enable_partial_load", true, "serve cells of an area; the differential service is always there"))
      serve<srv::GetPartialPointCloudMap>("service/get_partial_pcd_map");
    if (flag("enable_selected_load", false, "serve cells by id"))
      serve<srv::GetSelectedPointCloudMap>("service/get_selected_pcd_map");
    serve<srv::GetDifferentialPointCloudMap>("service/get_differential_pcd_map");
    say_what_is_not_used();
    timer_ = node.create_wall_timer(std::chrono::seconds(1), [this] { publish_state(); });
    threads_.emplace_back([this] { follow_map(); });
    if (!wholes_.empty()) threads_.emplace_back([this] { make_wholes(); });
  }
  Served(const Served&) = delete;
  Served& operator=(const Served&) = delete;

  ~Served() {
    timer_->cancel();
    requests_.stop();
    { const std::lock_guard<std::mutex> lock(mutex_); }
    ended_.notify_all();
    for (auto& thread : threads_) thread.join();
  }

 private:
  struct Whole {
    std::string layer;
    rclcpp::Publisher<Cloud>::SharedPtr publisher;
    std::size_t made = 0;  // number of the listing that it shows
  };

  // --- parameters, which can be set at the start alone ---

  rclcpp::ParameterValue declare(const char* name, const rclcpp::ParameterValue& value, const char* description,
                                 bool loose) {
    rcl_interfaces::msg::ParameterDescriptor what;
    what.description = description;
    what.read_only = true;
    what.dynamic_typing = loose;
    return node_.declare_parameter(name, value, what);
  }
  bool flag(const char* name, bool value, const char* description) {
    return declare(name, rclcpp::ParameterValue(value), description, false).get<bool>();
  }
  std::string text(const char* name, const char* description) {
    return declare(name, rclcpp::ParameterValue(""), description, false).get<std::string>();
  }
  /// A number, which may be given as a whole one.
  double number(const char* name, double value, double lowest, const char* description) {
    const auto given = declare(name, rclcpp::ParameterValue(value), description, true);
    double found = std::nan("");
    if (given.get_type() == rclcpp::PARAMETER_DOUBLE) found = given.get<double>();
    if (given.get_type() == rclcpp::PARAMETER_INTEGER) found = static_cast<double>(given.get<std::int64_t>());
    if (found >= lowest && std::isfinite(found)) return found;
    throw InvalidParameterValueException("parameter " + std::string(name) + ": expected a number, " +
                                         text_of(lowest) + " or more, not " + rclcpp::to_string(given));
  }

  shmmap::LoaderOptions loader_options() {
    shmmap::LoaderOptions found;
    found.client.endpoint =
        text("endpoint", "the daemon's socket, or its instance's name; empty: where it usually is");
    found.client.name = "shmmap_ros";
    found.wait = number("wait", 30.0, 0.0, "seconds that a request's cells may load; then those that are there are sent");
    found.wait = std::min(found.wait, 3600.0);  // which is all that a daemon takes
    found.plain_ids =
        flag("plain_ids", false, "ids without versions, as Autoware's; a changed cell is then not sent again");
    found.max_bytes = 2'147'400'000;  // of the 2^31 - 1 of a message
    return found;
  }

  Log log() const {
    const auto logger = node_.get_logger();
    return {[logger](const std::string& line) { RCLCPP_ERROR(logger, "%s", line.c_str()); },
            [logger](const std::string& line) { RCLCPP_WARN(logger, "%s", line.c_str()); },
            [logger](const std::string& line) { RCLCPP_INFO(logger, "%s", line.c_str()); }};
  }

  void say_what_is_not_used() {
    declare("pcd_paths_or_directory", rclcpp::ParameterValue(std::vector<std::string>{""}),
            "not used: the map is the daemon's", true);
    text("pcd_metadata_path", "not used: the map is the daemon's");
    std::string ours, python;
    for (const auto& [name, value] : node_.get_node_parameters_interface()->get_parameter_overrides()) {
      if (name.compare(0, 4, "pcd_") == 0) ours += " " + name;
      if (name == "live" || name.compare(0, 7, "around.") == 0 || name.compare(0, 14, "projected_map.") == 0)
        python += " " + name;
    }
    if (!ours.empty()) RCLCPP_INFO(node_.get_logger(), "not used, for the map is the daemon's:%s", ours.c_str());
    if (!python.empty())
      RCLCPP_WARN(node_.get_logger(), "not used, for shmmap-ros-node alone shows the map:%s", python.c_str());
  }

  // --- services ---

  template <typename Service>
  void serve(const char* name) {
    const rclcpp::QoS services = rclcpp::ServicesQoS().keep_last(depth);
#if RCLCPP_VERSION_GTE(28, 0, 0)  // Jazzy
    const auto& qos = services;
#else
    const rmw_qos_profile_t qos = services.get_rmw_qos_profile();
#endif
    const auto sending = std::make_shared<std::mutex>();  // rcl sends one answer of a service at a time
    services_.push_back(node_.create_service<Service>(
        name,
        [this, sending](std::shared_ptr<rclcpp::Service<Service>> service, std::shared_ptr<rmw_request_id_t> id,
                        std::shared_ptr<typename Service::Request> request) {
          requests_.ask<Service>(std::move(request), [this, sending, service, id](auto& response) {
            if (!frame_id_.empty()) response.header.frame_id = frame_id_;
            const std::lock_guard<std::mutex> lock(*sending);
            service->send_response(*id, response);
          });
        },
        qos));
  }

  // --- topics ---

  /// Publish the list of cells whenever it has changed.
  void follow_map() {
    MapWatch watch(options_.client, requests_);
    do {
      auto listing = watch.look();
      if (!listing) continue;
      msg::PointCloudMapMetaData message;
      message.header.stamp = node_.now();
      message.header.frame_id = frame_id_.empty() ? listing->frame_id : frame_id_;
      for (const auto& cell : listing->cells) {
        auto& one = message.metadata_list.emplace_back();
        one.cell_id = options_.plain_ids ? cell.id : shmmap::versioned_id(cell.id, cell.version);
        one.metadata.min_x = static_cast<float>(cell.min_x);
        one.metadata.min_y = static_cast<float>(cell.min_y);
        one.metadata.max_x = static_cast<float>(cell.max_x);
        one.metadata.max_y = static_cast<float>(cell.max_y);
      }
      publish(*metadata_, message);
      RCLCPP_INFO(node_.get_logger(), "a map of %zu cells", message.metadata_list.size());
      const std::lock_guard<std::mutex> lock(mutex_);
      cells_ = std::move(listing->cells);
      ++listed_;
    } while (!has_ended(look));
  }

  /// Publish the whole map, and the downsampled one, whenever it has changed.
  void make_wholes() {
    while (!has_ended(look)) {
      for (auto& whole : wholes_) {
        std::unique_lock<std::mutex> lock(mutex_);
        const auto cells = cells_;
        const auto listed = listed_;
        lock.unlock();
        if (whole.made == listed) continue;
        bool is_tried_again = false;
        try {
          auto options = options_.client;
          options.keep_waiting = [this] { return !requests_.is_stopped(); };
          shmmap::Client client(std::move(options));
          auto cloud = whole_cloud<Cloud>(client, cells, whole.layer, options_.wait);
          cloud.header.stamp = node_.now();
          if (!frame_id_.empty()) cloud.header.frame_id = frame_id_;
          publish(*whole.publisher, cloud);
        } catch (const shmmap::BadRequest& error) {  // that is too large until the map changes
          say_missing(whole, error);
        } catch (const std::exception& error) {
          if (requests_.is_stopped()) return;
          say_missing(whole, error);
          is_tried_again = true;
        }
        if (!is_tried_again) whole.made = listed;
        else if (has_ended(retry)) return;
      }
    }
  }

  void say_missing(const Whole& whole, const std::exception& error) {
    RCLCPP_ERROR(node_.get_logger(), "%s is not published: %s", whole.publisher->get_topic_name(), error.what());
  }

  /// Publish the node's state.
  void publish_state() {
    DiagnosticArray message;
    message.header.stamp = node_.now();
    auto& status = message.status.emplace_back();
    const bool is_there = requests_.is_reachable();
    const auto left_out = requests_.left_out();
    if (left_out != left_out_) left_out_ = left_out, left_out_at_ = Clock::now();
    status.name = "pointcloud_map_loader: shmmap";
    status.message = "serves the daemon's map";
    if (!is_there) {
      status.level = DiagnosticStatus::ERROR;
      status.message = "no daemon answers: requests wait";
    } else if (left_out != 0 && Clock::now() - left_out_at_ < warn) {
      status.level = DiagnosticStatus::WARN;
      status.message = "cells were left out of answers";
    }
    const auto add = [&status](const char* key, std::string value) {
      auto& one = status.values.emplace_back();
      one.key = key;
      one.value = std::move(value);
    };
    std::unique_lock<std::mutex> lock(mutex_);
    const auto cells = cells_.size();
    lock.unlock();
    add("daemon", is_there ? "reachable" : "away");
    add("cells", std::to_string(cells));
    add("requests waiting", std::to_string(requests_.waiting()));
    add("cells left out", std::to_string(left_out));
    publish(*diagnostics_, message);
  }

  template <typename Publisher, typename Message>
  void publish(Publisher& publisher, const Message& message) {
    try {
      publisher.publish(message);
    } catch (const std::exception& error) {  // as at the end of the context
      if (!requests_.is_stopped() && rclcpp::ok()) RCLCPP_ERROR(node_.get_logger(), "%s", error.what());
    }
  }

  bool has_ended(std::chrono::seconds within) {
    std::unique_lock<std::mutex> lock(mutex_);
    return ended_.wait_for(lock, within, [this] { return requests_.is_stopped(); });
  }

  MapLoader& node_;
  const std::string frame_id_;
  const shmmap::LoaderOptions options_;
  Requests requests_;
  rclcpp::Publisher<msg::PointCloudMapMetaData>::SharedPtr metadata_;
  rclcpp::Publisher<DiagnosticArray>::SharedPtr diagnostics_;
  std::vector<Whole> wholes_;
  std::vector<rclcpp::ServiceBase::SharedPtr> services_;
  rclcpp::TimerBase::SharedPtr timer_;
  std::mutex mutex_;
  std::condition_variable ended_;
  std::vector<shmmap::MapCell> cells_;
  std::size_t listed_ = 0;  // how often the list has changed
  std::size_t left_out_ = 0;
  Clock::time_point left_out_at_;
  std::vector<std::thread> threads_;
};

MapLoader::MapLoader(const rclcpp::NodeOptions& options)
    : Node("pointcloud_map_loader", "/map", with_names(options)), served_(std::make_unique<Served>(*this)) {}

MapLoader::~MapLoader() = default;

}  // namespace shmmap_ros

RCLCPP_COMPONENTS_REGISTER_NODE(shmmap_ros::MapLoader)
