// SPDX-License-Identifier: Apache-2.0
// pcl::NormalDistributionsTransform between two raw clouds (float32 x y z).  Usage: pcl_ndt TARGET SOURCE LEAF;
// each line of stdin is answered by one of JSON.  A pose is X Y Z ROLL PITCH YAW.
//   evaluate POSE REPEATS                  score, gradient and Hessian there; the least CPU time of one evaluation
//   align POSE EPSILON MAX_ITERATIONS      from that guess: iterations, transform, score per point
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/registration/ndt.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <iostream>
#include <string>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;
using Vector6 = Eigen::Matrix<double, 6, 1>;
using Matrix6 = Eigen::Matrix<double, 6, 6>;

struct Ndt : pcl::NormalDistributionsTransform<pcl::PointXYZ, pcl::PointXYZ> {
  // the protected method that every iteration of PCL's calls once
  double evaluate(const Vector6& pose, const Cloud& moved, Vector6& gradient, Matrix6& hessian) {
    return computeDerivatives(gradient, hessian, moved, pose);
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

template <typename Matrix>
static void print(const char* name, const Matrix& matrix) {  // row after row
  std::printf(", \"%s\": [", name);
  for (int row = 0; row < matrix.rows(); ++row)
    for (int column = 0; column < matrix.cols(); ++column)
      std::printf("%s%.17g", row || column ? ", " : "", static_cast<double>(matrix(row, column)));
  std::printf("]");
}

int main(int count, char** words) {
  if (count != 4) return 2;
  const auto target = read(words[1]), source = read(words[2]);
  Ndt ndt;
  ndt.setResolution(static_cast<float>(std::atof(words[3])));
  ndt.setInputTarget(target);
  ndt.setInputSource(source);
  Cloud moved;
  // aligning once sets the constants and the fixed parts of the derivatives, as for any user of PCL
  ndt.setMaximumIterations(1);
  ndt.align(moved);
  std::string what;
  Vector6 pose;
  while (std::cin >> what >> pose[0] >> pose[1] >> pose[2] >> pose[3] >> pose[4] >> pose[5]) {
    Eigen::Matrix4f T;
    Ndt::convertTransform(pose, T);
    if (what == "evaluate") {
      int repeats = 1;
      std::cin >> repeats;
      pcl::transformPointCloud(*source, moved, T);
      double best = 1e9, score = 0;
      Vector6 gradient;
      Matrix6 hessian;
      for (int i = 0; i < repeats; ++i) {
        const double begin = cpu_ms();
        score = ndt.evaluate(pose, moved, gradient, hessian);
        best = std::min(best, cpu_ms() - begin);
      }
      std::printf("{\"ms\": %.6f, \"score\": %.17g", best, score);
      print("gradient", gradient);
      print("hessian", hessian);
    } else {
      double epsilon = 0;
      int iterations = 0;
      std::cin >> epsilon >> iterations;
      ndt.setTransformationEpsilon(epsilon);
      ndt.setMaximumIterations(iterations);
      ndt.align(moved, T);
      std::printf("{\"iterations\": %d, \"score_per_point\": %.17g", ndt.getFinalNumIteration(),
                  ndt.getTransformationLikelihood());
      print("T", ndt.getFinalTransformation());
    }
    std::printf("}\n");
    std::fflush(stdout);
  }
}
