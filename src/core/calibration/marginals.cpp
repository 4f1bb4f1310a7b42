#include "imu_pose_calib/core/calibration/marginals.h"

#include <algorithm>
#include <cmath>

namespace imu_pose_calib {

int Marginals::Find(ParameterKind kind, size_t imu, size_t session) const {
  const bool is_of_imu = kind != ParameterKind::kGravity && !IsOfPoses(kind);
  const bool is_of_session = kind == ParameterKind::kGravity || kind == ParameterKind::kGyroBias ||
                             kind == ParameterKind::kAccelBias || IsOfSession(kind);
  for (const PlacedParameter& p : parameters)
    if (p.parameter.kind == kind && (!is_of_imu || p.parameter.imu == imu) &&
        (!is_of_session || p.parameter.session == session))
      return p.place;
  return -1;
}

int Marginals::FindColumn(ParameterKind kind, size_t imu) const {
  int column = 0;
  for (const PlacedParameter& p : parameters) {
    if (!p.is_estimated) continue;
    if (p.parameter.kind == kind && p.parameter.imu == imu) return column;
    column += p.parameter.size;
  }
  return -1;
}

Eigen::VectorXd Enlargement(const Eigen::MatrixXd& model, const Eigen::MatrixXd& robust) {
  Eigen::VectorXd factor = Eigen::VectorXd::Ones(model.rows());
  for (Eigen::Index i = 0; i < model.rows(); ++i)
    if (model(i, i) > 0.0) factor[i] = std::sqrt(std::max(1.0, robust(i, i) / model(i, i)));
  return factor;
}

}  // namespace imu_pose_calib
