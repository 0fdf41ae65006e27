// SPDX-License-Identifier: Apache-2.0
// Times pcl::NormalDistributionsTransform on two raw clouds (float32 x y z): one evaluation of score, gradient
// and Hessian at a pose.  Usage: ndt_pcl TARGET SOURCE LEAF X Y Z YAW REPEATS; prints JSON.
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/registration/ndt.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <vector>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

struct Ndt : pcl::NormalDistributionsTransform<pcl::PointXYZ, pcl::PointXYZ> {
  // the protected method that every iteration of PCL's calls once
  double evaluate(const Eigen::Matrix<double, 6, 1>& pose, const Cloud& moved, double* norm) {
    Eigen::Matrix<double, 6, 1> gradient;
    Eigen::Matrix<double, 6, 6> hessian;
    const double score = computeDerivatives(gradient, hessian, moved, pose);
    *norm = gradient.norm();
    return score;
  }
  // aligning once sets the constants and the fixed parts of the derivatives, as for any user of PCL
  void prepare() {
    Cloud aligned;
    setMaximumIterations(1);
    align(aligned);
  }
};

static Cloud::Ptr read(const char* path) {
  std::ifstream file(path, std::ios::binary);
  auto cloud = std::make_shared<Cloud>();
  float xyz[3];
  while (file.read(reinterpret_cast<char*>(xyz), sizeof xyz)) cloud->emplace_back(xyz[0], xyz[1], xyz[2]);
  return cloud;
}

static double cpu_ms() {
  timespec now;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return now.tv_sec * 1e3 + now.tv_nsec * 1e-6;
}

int main(int count, char** words) {
  if (count != 9) return 2;
  const auto target = read(words[1]), source = read(words[2]);
  const double yaw = std::atof(words[7]);
  Ndt ndt;
  ndt.setResolution(static_cast<float>(std::atof(words[3])));
  ndt.setInputTarget(target);
  ndt.setInputSource(source);
  ndt.prepare();
  Eigen::Matrix<double, 6, 1> pose;
  pose << std::atof(words[4]), std::atof(words[5]), std::atof(words[6]), 0, 0, yaw;
  Eigen::Affine3f T = Eigen::Translation3f(pose.head<3>().cast<float>()) *
                      Eigen::AngleAxisf(static_cast<float>(yaw), Eigen::Vector3f::UnitZ());
  Cloud moved;
  pcl::transformPointCloud(*source, moved, T);
  double best = 1e9, score = 0, norm = 0;
  for (int i = 0; i < std::atoi(words[8]); ++i) {
    const double begin = cpu_ms();
    score = ndt.evaluate(pose, moved, &norm);
    best = std::min(best, cpu_ms() - begin);
  }
  std::printf("{\"ms\": %.6f, \"score\": %.9f, \"gradient\": %.9f}\n", best, score, norm);
}
