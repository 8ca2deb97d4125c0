// A data set of a few rows, for tests that corrupt it.
#pragma once

#include "test/support/scratch_folder.hpp"

namespace groma::test {

inline void write_small_dataset(const ScratchFolder& folder) {
  folder.write("dataset.yaml",
               "schema: 1\n"
               "name: small\n"
               "origin: simulated\n"
               "odometry: {sigma_vx_mps: 0.02, sigma_vy_mps: 0.03, sigma_omega_radps: 0.006}\n"
               "range: {sigma_m: 0.08, beta_m: [0.2, 0.3], gamma: [1, 0.005]}\n"
               "surface: {type: bspline, file: surface.csv}\n");
  folder.write("tags.csv", "tag_id,x_m,y_m,z_m\n1,0.75,0.45,1.9\n2,-0.7,-0.42,1.25\n");
  folder.write("anchors.csv", "anchor_id,x_m,y_m,z_m\n5,3.5,12.25,3.1\n4,2.5,1.75,2.75\n");
  folder.write("ranges.csv", "t_s,tag_id,anchor_id,range_m\n0.1,1,4,5.25\n0.2,2,4,4.5\n0.3,1,5,8.125\n");
  folder.write("odometry.csv", "t_s,vx_mps,vy_mps,omega_radps\n0,0.5,0,0.01\n0.1,0.5,0.01,0\n");
  folder.write("groundtruth.csv", "t_s,x_m,y_m,z_m,yaw_rad\n0,1,2,0,0.5\n0.1,1.05,2,0,0.5\n");
  folder.write("pose_prior.csv", "t_s,x_m,y_m,z_m,yaw_rad,roll_rad\n0,1.01,2.02,0,0.51,0.02\n");
  folder.write("surface.csv",
               "# x0_m,y0_m,dx_m,dy_m,nx,ny\n-3,-4,1,2,4,5\n"
               "0,0,0,0,0\n0,0.1,0.2,0.3,0.4\n0,0,0,0,0\n1,1,1,1,1.5\n");
}

}  // namespace groma::test
