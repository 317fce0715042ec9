// The parts of ROS that map_merge's library needs, so that it builds without ROS: messages, log macros, checks.
#pragma once

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <vector>

namespace geometry_msgs::msg {
struct Vector3 {
  double x = 0.0, y = 0.0, z = 0.0;
};
using Point = Vector3;
struct Quaternion {
  double x = 0.0, y = 0.0, z = 0.0, w = 1.0;
};
struct Transform {
  Vector3 translation;
  Quaternion rotation;
};
struct Pose {
  Point position;
  Quaternion orientation;
};
}  // namespace geometry_msgs::msg

namespace nav_msgs::msg {
struct MapMetaData {
  float resolution = 0.0F;
  std::uint32_t width = 0, height = 0;
  geometry_msgs::msg::Pose origin;
};
struct OccupancyGrid {
  using SharedPtr = std::shared_ptr<OccupancyGrid>;
  using ConstSharedPtr = std::shared_ptr<const OccupancyGrid>;
  MapMetaData info;
  std::vector<std::int8_t> data;  // row by row from the lower left corner: 0 free, 100 occupied, -1 unknown
};
}  // namespace nav_msgs::msg

namespace rclcpp {
struct Logger {};
inline Logger get_logger(const char*) { return {}; }
}  // namespace rclcpp

#define RCLCPP_DEBUG(logger, ...) static_cast<void>(logger)
#define RCLCPP_WARN(logger, ...) static_cast<void>(logger)

namespace rcpputils {
inline void require_true(bool holds) {
  if (!holds) throw std::invalid_argument("a requirement of map_merge does not hold");
}
inline void check_true(bool holds) { require_true(holds); }
inline void assert_true(bool holds) { require_true(holds); }
}  // namespace rcpputils
