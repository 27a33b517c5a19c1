// Servoes an arm that fixed cameras watch by ViSP, eye-to-hand, through pipes.
//
//   g++ -O2 eye_to_hand.cpp -o eye_to_hand -lvisp_core -lvisp_vision -lvisp_visual_features -lvisp_vs
//
// Words and numbers come in, separated by white space. A run begins with
//   set ibvs|pbvs, gain (1/s), number of joints n, of points k, of cameras V
//   k points (x y z) of the object in its frame, m
//   for each camera fx fy u0 v0 (px), the 4x4 pose cMf of the base in its frame, k pixels (u v) of the goal
// and each of its periods is
//   move, fMe: the 4x4 pose of the hand in the base, eJe (6 x n): the Jacobian of the hand in its own frame
//   k pixels (u v) for each camera
// The answer to both is a line: "ready" or n joint velocities, rad/s, or "lost" where no pose of the points is found.
//
// The law of each camera is vpServo's EYETOHAND_L_cVf_fVe_eJe with the current interaction matrix. Several cameras
// are stacked: one pseudo-inverse of their Jacobians. IBVS measures vpFeaturePoint, with depths from vpPose. PBVS
// measures the translation of the object before the camera and the rotation theta u to the goal.

#include <cmath>
#include <iomanip>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include <visp3/core/vpCameraParameters.h>
#include <visp3/core/vpPixelMeterConversion.h>
#include <visp3/vision/vpPose.h>
#include <visp3/visual_features/vpFeaturePoint.h>
#include <visp3/visual_features/vpFeatureThetaU.h>
#include <visp3/visual_features/vpFeatureTranslation.h>
#include <visp3/vs/vpServo.h>

typedef std::vector<vpImagePoint> Pixels;

static void read(double &x)
{
  if (!(std::cin >> x)) std::exit(0); // the other end is gone
}

static vpMatrix read_matrix(unsigned rows, unsigned columns)
{
  vpMatrix M(rows, columns);
  for (unsigned i = 0; i < rows; ++i)
    for (unsigned j = 0; j < columns; ++j) read(M[i][j]);
  return M;
}

static vpHomogeneousMatrix read_pose()
{
  vpMatrix M = read_matrix(4, 4);
  vpHomogeneousMatrix T;
  for (unsigned i = 0; i < 3; ++i)
    for (unsigned j = 0; j < 4; ++j) T[i][j] = M[i][j];
  return T;
}

static Pixels read_pixels(size_t count)
{
  Pixels pixels;
  for (size_t i = 0; i < count; ++i) {
    double u, v;
    read(u);
    read(v);
    pixels.push_back(vpImagePoint(v, u)); // row and column
  }
  return pixels;
}

// A camera with the task of ViSP that it measures.
class View
{
public:
  View(const std::string &kind, double gain, const vpMatrix &points) : points(points), ibvs(kind == "ibvs")
  {
    double fx, fy, u0, v0;
    read(fx);
    read(fy);
    read(u0);
    read(v0);
    camera.initPersProjWithoutDistortion(fx, fy, u0, v0);
    cMf = read_pose();
    Pixels goal = read_pixels(points.getRows());
    valid = pose_of(goal, cdMo);
    task.setServo(vpServo::EYETOHAND_L_cVf_fVe_eJe);
    task.setInteractionMatrixType(vpServo::CURRENT, vpServo::PSEUDO_INVERSE);
    task.setLambda(gain);
    task.set_cVf(cMf);
    if (ibvs) {
      p.resize(goal.size());
      pd.resize(goal.size());
      place(goal, cdMo, pd);
      for (size_t i = 0; i < goal.size(); ++i) task.addFeature(p[i], pd[i]);
    }
    else {
      td.buildFrom(cdMo);
      task.addFeature(t, td);
      task.addFeature(tu);
    }
  }

  // Measure the object; false where it shows no pose.
  bool measure(const Pixels &pixels)
  {
    vpHomogeneousMatrix cMo;
    if (!pose_of(pixels, cMo)) return false;
    if (ibvs) {
      place(pixels, cMo, p);
    }
    else {
      t.buildFrom(cMo);
      tu.buildFrom(cdMo * cMo.inverse());
    }
    return true;
  }

  // Joint velocities of this camera alone; the task then has its Jacobian and error.
  vpColVector command(const vpHomogeneousMatrix &fMe, const vpMatrix &eJe)
  {
    task.set_fVe(fMe);
    task.set_eJe(eJe);
    return task.computeControlLaw();
  }

  vpServo task;
  bool valid; // whether the goal shows a pose

private:
  // Pose from the points: from the last one and anew, the one that leaves less.
  bool pose_of(const Pixels &pixels, vpHomogeneousMatrix &cMo)
  {
    vpPose pose;
    for (size_t i = 0; i < pixels.size(); ++i) {
      double x = 0, y = 0;
      vpPixelMeterConversion::convertPoint(camera, pixels[i], x, y);
      vpPoint point(points[i][0], points[i][1], points[i][2]);
      point.set_x(x);
      point.set_y(y);
      pose.addPoint(point);
    }
    double least = INFINITY;
    const vpPose::vpPoseMethodType methods[] = {vpPose::VIRTUAL_VS, vpPose::DEMENTHON_VIRTUAL_VS,
                                                vpPose::LAGRANGE_VIRTUAL_VS};
    for (size_t i = tracked ? 0 : 1; i < 3; ++i) {
      vpHomogeneousMatrix found = last;
      try {
        if (!pose.computePose(methods[i], found)) continue;
      }
      catch (const vpException &) {
        continue;
      }
      double residual = pose.computeResidual(found);
      if (std::isfinite(residual) && residual < least && found[2][3] > 0) {
        least = residual;
        cMo = found;
      }
    }
    tracked = std::isfinite(least);
    if (tracked) last = cMo;
    return tracked;
  }

  // Points in the normalized image, with their depths at a pose.
  void place(const Pixels &pixels, const vpHomogeneousMatrix &cMo, std::vector<vpFeaturePoint> &features) const
  {
    for (size_t i = 0; i < pixels.size(); ++i) {
      double x = 0, y = 0;
      vpPixelMeterConversion::convertPoint(camera, pixels[i], x, y);
      vpColVector X(4, 1.0);
      for (unsigned j = 0; j < 3; ++j) X[j] = points[i][j];
      features[i].buildFrom(x, y, (cMo * X)[2]);
    }
  }

  vpMatrix points;
  bool ibvs;
  bool tracked = false;
  vpCameraParameters camera;
  vpHomogeneousMatrix cMf, cdMo, last;
  std::vector<vpFeaturePoint> p, pd;
  vpFeatureTranslation t{vpFeatureTranslation::cMo}, td{vpFeatureTranslation::cMo};
  vpFeatureThetaU tu{vpFeatureThetaU::cdRc};
};

int main()
{
  std::string word, kind;
  double gain = 0, n = 0, k = 0, V = 0;
  std::vector<std::unique_ptr<View>> views;
  std::cout << std::setprecision(17);
  while (std::cin >> word) {
    bool seen = true;
    if (word == "set") {
      std::cin >> kind;
      for (double *x : {&gain, &n, &k, &V}) read(*x);
      vpMatrix points = read_matrix(static_cast<unsigned>(k), 3);
      views.clear();
      for (int i = 0; i < V; ++i) views.push_back(std::unique_ptr<View>(new View(kind, gain, points)));
      for (auto &view : views) seen = view->valid && seen;
      std::cout << (seen ? "ready" : "lost") << std::endl;
      continue;
    }
    vpHomogeneousMatrix fMe = read_pose();
    vpMatrix eJe = read_matrix(6, static_cast<unsigned>(n)), J;
    vpColVector e, q_dot;
    for (auto &view : views) seen = view->measure(read_pixels(static_cast<size_t>(k))) && seen;
    for (size_t i = 0; seen && i < views.size(); ++i) {
      q_dot = views[i]->command(fMe, eJe);
      J.stack(views[i]->task.getTaskJacobian());
      e.stack(views[i]->task.getError());
    }
    if (seen && views.size() > 1) q_dot = -gain * J.pseudoInverse() * e;
    if (seen)
      for (unsigned i = 0; i < q_dot.size(); ++i) std::cout << q_dot[i] << ' ';
    else
      std::cout << "lost";
    std::cout << std::endl;
  }
}
