// Places one occupancy grid in another by MergingPipeline, the library of the ROS node map_merge.
//
//   map_merge FIRST.yaml SECOND.yaml [AKAZE|ORB [CONFIDENCE]]
//
// The maps are as nav2's map_server reads them. Prints `x y yaw confidence`, the pose of the second map's frame in that
// of the first, m and rad; or `none`. Features and confidence are those of the node, AKAZE and 1.0, if they are not given.
#include <array>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <iostream>
#include <numeric>
#include <stdexcept>
#include <string>
#include <vector>

#include <opencv2/core.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/stitching/detail/matchers.hpp>
#include <yaml-cpp/yaml.h>

#include "ros_stand_ins.hpp"

// The node warps grids by these matrices; the transforms that the library returns lack their scale.
#define private public
#include <combine_grids/merging_pipeline.h>
#undef private

#include "estimation_internal.h"

using combine_grids::FeatureType;
using Grid = nav_msgs::msg::OccupancyGrid;
using Grids = std::array<Grid::ConstSharedPtr, 2>;

namespace {

constexpr int kSeed = 0;

// The grid that map_server makes of an image, in its mode `trinary`.
Grid::ConstSharedPtr readMap(const std::filesystem::path& path) {
  const YAML::Node map = YAML::LoadFile(path.string());
  const auto origin = map["origin"].as<std::vector<double>>();
  if (origin.at(2) != 0.0 || map["negate"].as<int>() != 0) {
    throw std::runtime_error(path.string() + " has a turned or negated image: write it without");
  }
  const cv::Mat image =
      cv::imread((path.parent_path() / map["image"].as<std::string>()).string(), cv::IMREAD_GRAYSCALE);
  if (image.empty()) throw std::runtime_error(path.string() + " names an image that cannot be read");
  const double occupied = map["occupied_thresh"].as<double>(), free = map["free_thresh"].as<double>();
  auto grid = std::make_shared<Grid>();
  grid->info.resolution = map["resolution"].as<float>();
  grid->info.width = static_cast<std::uint32_t>(image.cols);
  grid->info.height = static_cast<std::uint32_t>(image.rows);
  grid->info.origin.position.x = origin.at(0);
  grid->info.origin.position.y = origin.at(1);
  grid->data.reserve(image.total());
  for (int row = image.rows - 1; row >= 0; --row) {
    for (int column = 0; column < image.cols; ++column) {
      const double occupancy = (255 - image.at<std::uint8_t>(row, column)) / 255.0;
      grid->data.push_back(occupancy > occupied ? 100 : occupancy < free ? 0 : -1);
    }
  }
  return grid;
}

// The position of a pixel's center in the frame of the map, m.
cv::Vec2d inMap(const Grid& grid, const cv::Vec2d& pixel) {
  const auto& origin = grid.info.origin.position;
  return cv::Vec2d(origin.x, origin.y) + double(grid.info.resolution) * (pixel + cv::Vec2d(0.5, 0.5));
}

struct Match {
  double confidence = 0.0;
  cv::Vec2d center;  // of the features of the second grid that are inliers, pixels
};

// Confidence and place of the match on which the library decides, which it does not return.
Match matchGrids(const std::vector<cv::Mat>& images, FeatureType type) {
  const auto finder = combine_grids::internal::chooseFeatureFinder(type);
  std::vector<cv::detail::ImageFeatures> features(images.size());
  for (std::size_t i = 0; i < images.size(); ++i) cv::detail::computeImageFeatures(finder, images[i], features[i]);
  std::vector<cv::detail::MatchesInfo> found;
  cv::detail::AffineBestOf2NearestMatcher matcher;
  matcher(features, found);
  const cv::detail::MatchesInfo& match = found.at(1);  // of the first in the second
  Match result{match.confidence, {}};
  for (std::size_t k = 0; k < match.matches.size(); ++k) {
    if (!match.inliers_mask[k]) continue;
    const cv::Point2f point = features[1].keypoints[static_cast<std::size_t>(match.matches[k].trainIdx)].pt;
    result.center += cv::Vec2d(point.x, point.y) / match.num_inliers;
  }
  return result;
}

int placeGrids(const Grids& grids, FeatureType type, double threshold) {
  combine_grids::MergingPipeline pipeline;
  pipeline.feed(grids.begin(), grids.end());
  cv::setRNGSeed(kSeed);
  const bool found = pipeline.estimateTransforms({}, type, threshold);
  const std::vector<cv::Mat>& transforms = pipeline.transforms_;  // from the pixels of one of the grids to those of each
  if (!found || transforms.size() != 2 || transforms[0].empty() || transforms[1].empty()) {
    std::puts("none");
    return 0;
  }
  cv::setRNGSeed(kSeed);
  const Match match = matchGrids(pipeline.images_, type);
  const cv::Matx33d inFirst = cv::Mat(transforms[0] * transforms[1].inv());
  const double yaw = std::atan2(inFirst(1, 0), inFirst(0, 0));
  // The scale is left out: the pose is exact where the grids match.
  const cv::Vec3d center = inFirst * cv::Vec3d(match.center[0], match.center[1], 1.0);
  const cv::Vec2d first = inMap(*grids[0], {center[0], center[1]}), second = inMap(*grids[1], match.center);
  const cv::Matx22d rotation(std::cos(yaw), -std::sin(yaw), std::sin(yaw), std::cos(yaw));
  const cv::Vec2d position = first - rotation * second;
  std::printf("%.6f %.6f %.6f %.6f\n", position[0], position[1], yaw, match.confidence);
  std::fprintf(stderr, "scale %.6f\n", std::hypot(inFirst(0, 0), inFirst(1, 0)));
  return 0;
}

FeatureType featureType(const std::string& name) {
  if (name == "AKAZE") return FeatureType::AKAZE;
  if (name == "ORB") return FeatureType::ORB;
  throw std::runtime_error("there are no features " + name + ": choose AKAZE or ORB");
}

}  // namespace

int main(int count, char** arguments) {
  const std::vector<std::string> words(arguments + 1, arguments + count);
  if (words.size() < 2 || words.size() > 4) {
    std::cerr << "usage: map_merge FIRST.yaml SECOND.yaml [AKAZE|ORB [CONFIDENCE]]\n";
    return 2;
  }
  try {
    cv::setNumThreads(1);
    return placeGrids({readMap(words[0]), readMap(words[1])}, featureType(words.size() > 2 ? words[2] : "AKAZE"),
                      words.size() > 3 ? std::stod(words[3]) : 1.0);
  } catch (const std::exception& fault) {
    std::cerr << fault.what() << '\n';
    return 1;
  }
}
