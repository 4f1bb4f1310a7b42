#include <algorithm>
#include <cmath>
#include <optional>
#include <string>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/verdict/verdict.h"

namespace imu_pose_calib {
namespace {

/// Least share of a session's variance that its difference from the common estimate has: a session
/// that determines a component alone cannot disagree about it.
constexpr double kLeastDifference = 0.05;

/// A component of the rig that sessions tell of alone.
struct Component {
  int place;
  std::string name, unit;  ///< "translation z"; "m"
};

std::vector<Component> Components(const Marginals& marginals, size_t imus) {
  std::vector<Component> components;
  for (const PlacedParameter& p : marginals.parameters) {
    const std::string of = OfImu(p.parameter.imu, imus);
    const auto add_axes = [&](const char* name, const char* unit) {
      for (int k = 0; k < 3; ++k)
        components.push_back({p.place + k, name + of + " " + "xyz"[k], unit});
    };
    if (p.parameter.kind == ParameterKind::kTranslation) add_axes("translation", "m");
    if (p.parameter.kind == ParameterKind::kRotation) add_axes("rotation", "rad");
    if (p.parameter.kind == ParameterKind::kAccelDelay)
      components.push_back({p.place, "accel_delay" + of, "s"});
  }
  return components;
}

/// What a session says of one component: its own estimate less the common one, and the variances of
/// its own estimate, by the model too, and of the difference.
struct Deviation {
  double value, own_variance, own_model_variance, variance;
};

/// Nothing when the session does not tell of it. `common`: variance of the common estimate by the
/// model.
std::optional<Deviation> Deviate(const SessionMarginals& session, int place, double common) {
  const auto found = std::find(session.places.begin(), session.places.end(), place);
  if (found == session.places.end()) return std::nullopt;
  const auto k = found - session.places.begin();
  const double own = session.covariance(k, k), model = session.model_variance[k];
  if (!std::isfinite(own) || !std::isfinite(session.difference[k])) return std::nullopt;
  // The common estimate holds a share common / model of this one.
  const double apart = std::max(kLeastDifference, 1.0 - common / model);
  return Deviation{session.difference[k], own, model, apart * own};
}

/// Variance of a component of the common estimate as the scatter of the sessions shows it: its own
/// by the model, enlarged as those of the sessions are and by chi-square per degree of freedom less
/// one sigma of its scatter. 0 when they do not scatter more than they should.
double ScatterVariance(const std::vector<SessionMarginals>& sessions, int place, double common) {
  double chi2 = 0.0, dof = 0.0, enlargement = 0.0, count = 0.0;
  for (const SessionMarginals& session : sessions) {
    const auto difference = Deviate(session, place, common);
    if (!difference) continue;
    chi2 += difference->value * difference->value / difference->own_variance;
    dof += difference->variance / difference->own_variance;
    enlargement += difference->own_variance / difference->own_model_variance;
    count += 1.0;
  }
  if (dof == 0.0) return 0.0;
  const double growth = chi2 / dof - std::sqrt(2.0 / dof);
  return growth > 1.0 ? growth * enlargement / count * common : 0.0;
}

Agreement Judge(const SessionMarginals& session, const std::vector<Component>& components,
                const Eigen::MatrixXd& model) {
  Agreement agreement;
  for (const Component& component : components) {
    const int k = component.place;
    const auto difference = Deviate(session, k, model(k, k));
    if (!difference) continue;
    const double sigmas = std::abs(difference->value) / std::sqrt(difference->variance);
    agreement.chi2 += sigmas * sigmas;
    ++agreement.dof;
    if (sigmas <= agreement.sigmas) continue;
    agreement.sigmas = sigmas;
    agreement.worst = component.name;
    // From all others it is further than from the common estimate.
    agreement.difference = difference->value * difference->own_variance / difference->variance;
    agreement.unit = component.unit;
  }
  return agreement;
}

/// The rig's first IMU that the session has, as the session alone says.
OwnEstimate Own(const Marginals& marginals, const SessionMarginals& alone,
                const Calibration& result, size_t session) {
  const auto& imus = result.sessions[session].imus;
  const auto is_present = [](const ImuSession& imu) { return imu.is_present; };
  const auto imu =
      static_cast<size_t>(std::find_if(imus.begin(), imus.end(), is_present) - imus.begin());
  OwnEstimate own;
  own.imu = imu;
  own.T_MI = result.imus[imu].T_MI;
  own.accel_delay = result.imus[imu].accel_delay;
  own.time_shift = imus[imu].time_shift;
  const auto take = [&](ParameterKind kind, int size, auto* difference, auto* std_dev) {
    const int place = marginals.Find(kind, imu, session);
    if (place < 0) return;
    for (int k = 0; k < size; ++k) {
      const auto compared = Deviate(alone, place + k, 0.0);
      if (!compared) return;
      difference[k] = compared->value;
      std_dev[k] = std::sqrt(compared->own_variance);
    }
  };
  Eigen::Vector3d moved = Eigen::Vector3d::Zero(), turned = moved;
  double shift = 0.0, delay = 0.0;
  take(ParameterKind::kTranslation, 3, moved.data(), own.std.data());
  take(ParameterKind::kRotation, 3, turned.data(), own.std.data() + 3);
  take(ParameterKind::kTimeShift, 1, &shift, &own.time_shift_std);
  take(ParameterKind::kAccelDelay, 1, &delay, &own.accel_delay_std);
  own.T_MI = {(own.T_MI.q * Exp(turned)).normalized(), own.T_MI.p + moved};
  own.time_shift += shift;
  own.accel_delay += delay;
  return own;
}

}  // namespace

Marginals CompareSessions(Marginals marginals, Calibration* result) {
  const std::vector<SessionMarginals>& sessions = marginals.sessions;
  if (sessions.empty() || !marginals.model.allFinite() || !marginals.robust.allFinite())
    return marginals;
  const std::vector<Component> components = Components(marginals, result->imus.size());
  for (size_t s = 0; s < sessions.size(); ++s) {
    result->sessions[s].own = Own(marginals, sessions[s], *result, s);
    result->sessions[s].agreement = Judge(sessions[s], components, marginals.model);
  }
  for (const Component& component : components) {
    const int k = component.place;
    const double scatter = ScatterVariance(sessions, k, marginals.model(k, k));
    marginals.robust(k, k) = std::max(marginals.robust(k, k), scatter);
  }
  return marginals;
}

void TestSessionAgreement(Calibration* result) {
  if (result->sessions.size() < 2) return;
  size_t worst = 0;
  for (size_t s = 1; s < result->sessions.size(); ++s)
    if (result->sessions[s].agreement.sigmas > result->sessions[worst].agreement.sigmas) worst = s;
  const Agreement& agreement = result->sessions[worst].agreement;
  if (agreement.sigmas < kAgreementBound) return;
  const std::string who = result->sessions.size() == 2
                              ? "sessions 1 and 2 disagree"
                              : "session " + std::to_string(worst + 1) + " stands out";
  const std::string text =
      who + ": " + agreement.worst + " by " + InWords(agreement.difference, agreement.unit) + ", " +
      Number(agreement.sigmas, "%.1f sigma") + ": did the marker or the imu move?";
  // What they scatter by is in the sigmas: of those that make it degenerate it is the reason.
  result->message = result->status == Status::kWeak ? text + "; " + result->message : text;
  if (result->status == Status::kOk) result->status = Status::kWeak;
}

}  // namespace imu_pose_calib
