#include <algorithm>
#include <cmath>
#include <string>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/verdict/observability.h"

namespace imu_pose_calib {
namespace {

constexpr double kDisagreement = 5.0;  // sigma between the halves
/// Noise of poses in the solve over that of S1, which is at least the second of these.
constexpr double kIgnored = 10.0;
constexpr PoseStd kOrdinaryNoise{1e-3, 3e-3};  // [m], [rad]
/// Noise of the IMU's sensors in a solve against a given trajectory, over their own.
constexpr double kLostForce = 1.5, kLostRate = 2.0;
// Beyond what sources of poses do:
constexpr double kMostScale = 0.012;     // [1]
constexpr double kMostSmoothing = 4e-3;  // [s^2]
/// From which on the second moment is not enough to describe an accelerometer's filter.
constexpr double kMostAccelSmoothing = 1.2e-3;  // [s^2]

void DoubtHalves(const Calibration& result, std::vector<std::string>* doubts) {
  if (result.split_half.sigmas <= kDisagreement) return;
  const char* const halves = result.sessions.size() == 1
                                 ? "the two halves of the recording"
                                 : "the first and the second halves of the sessions";
  doubts->push_back(
      std::string(halves) + " disagree by up to " + Number(result.split_half.sigmas, "%.1f") +
      " sigma (translation " + InWords(result.split_half.translation.norm(), "m") + ", rotation " +
      InWords(result.split_half.rotation.norm(), "rad") + "): did the marker or the imu move?");
}

void DoubtNoise(const std::vector<PreparedSession>& sessions, const Calibration& result,
                std::vector<std::string>* doubts) {
  for (size_t s = 0; s < sessions.size(); ++s) {
    const auto check = [&](const char* name, double PoseStd::*member, const char* unit) {
      const double found = result.sessions[s].noise.*member;
      const double own = sessions[s].pose_noise.*member;
      if (found <= kIgnored * std::max(own, kOrdinaryNoise.*member)) return;
      doubts->push_back(std::string("the ") + name + " of the poses" +
                        OfSession(s, result.sessions.size()) + " are off by " +
                        InWords(found, unit) + " where they scatter by " + InWords(own, unit) +
                        ": the result hardly rests on them; are their stamps "
                        "right?");
    };
    check("positions", &PoseStd::position, "m");
    check("rotations", &PoseStd::rotation, "rad");
  }
}

void DoubtPoseSource(const Calibration& result, std::vector<std::string>* doubts) {
  if (std::abs(result.pose_scale - 1.0) > kMostScale)
    doubts->push_back("the positions seem off in scale by " +
                      Number(100.0 * (result.pose_scale - 1.0), "%+.1f") + " % (bound: " +
                      Number(100.0 * kMostScale, "%.1f") + " %): check the tracker's calibration");
  for (const double smoothing : {result.pose_smoothing, result.position_smoothing})
    if (std::abs(smoothing) > kMostSmoothing)
      doubts->push_back(std::string(smoothing > 0.0 ? "the poses" : "the imu's data") +
                        " seem smoothed over " + InWords(std::sqrt(std::abs(smoothing)), "s") +
                        " more than the " + (smoothing > 0.0 ? "imu's data" : "poses") +
                        " (bound: " + InWords(std::sqrt(kMostSmoothing), "s") +
                        "): something else is not as assumed");
}

void DoubtFilters(const Calibration& result, std::vector<std::string>* doubts) {
  for (size_t i = 0; i < result.imus.size(); ++i) {
    const double smoothing = result.imus[i].accel_smoothing;
    if (std::abs(smoothing) <= kMostAccelSmoothing) continue;
    doubts->push_back(std::string("the ") + (smoothing > 0.0 ? "accelerometer" : "gyroscope") +
                      OfImu(i, result.imus.size()) + " averages over " +
                      InWords(std::sqrt(std::abs(smoothing)), "s") + " more than the " +
                      (smoothing > 0.0 ? "gyroscope" : "accelerometer") +
                      " (bound: " + InWords(std::sqrt(kMostAccelSmoothing), "s") +
                      "), and what that does to fast motion is undone in part only: set a faster "
                      "filter, or move slowly");
  }
}

/// Noise of samples as their second differences show it, which hold little of the motion.
double OwnNoise(const std::vector<TimedSample>& samples) {
  std::vector<double> differences;
  for (size_t i = 2; i < samples.size(); ++i) {
    const Eigen::Vector3d second =
        samples[i].value - 2.0 * samples[i - 1].value + samples[i - 2].value;
    for (int k = 0; k < 3; ++k) differences.push_back(second[k] / std::sqrt(6.0));
  }
  return RobustSigma(std::move(differences));
}

/// What a given trajectory has lost of the motion, or has too much, remains in the residuals of the
/// IMU, and the lever arm has adapted to it.
void DoubtSmoothing(const std::vector<PreparedSession>& sessions, const Calibration& result,
                    std::vector<std::string>* doubts) {
  if (result.method != Method::kGp) return;
  for (size_t s = 0; s < sessions.size(); ++s) {
    for (size_t i = 0; i < result.imus.size(); ++i) {
      const ConditionedImu& imu = sessions[s].data.imus[i];
      if (!imu.IsPresent()) continue;
      const auto check = [&](const char* name, const std::vector<TimedSample>& samples,
                             double found, double bound, const char* unit) {
        const double own = OwnNoise(samples);
        if (found <= bound * own) return;
        doubts->push_back("method gp does not follow the motion" + OfSession(s, sessions.size()) +
                          ": it leaves the " + name + OfImu(i, result.imus.size()) +
                          " a noise of " + Number(found, "%.3g") + " " + unit + ", its own is " +
                          Number(own, "%.3g") + ", and p_MI is too short or too long: use joint");
      };
      const auto& noise = result.sessions[s].imus[i].noise;
      check("accelerometer", imu.accel, noise.accel, kLostForce, "m/s^2");
      check("gyroscope", imu.gyro, noise.gyro, kLostRate, "rad/s");
    }
  }
}

constexpr double kStandsOut = 5.0;  // sigma
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
    if (!p.is_estimated) continue;
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
struct Difference {
  double value, own_variance, own_model_variance, variance;
};

/// Nothing when the session does not tell of it. `common`: variance of the common estimate by the
/// model.
std::optional<Difference> Compare(const SessionMarginals& session, int place, double common) {
  const auto found = std::find(session.places.begin(), session.places.end(), place);
  if (found == session.places.end()) return std::nullopt;
  const auto k = found - session.places.begin();
  const double own = session.covariance(k, k), model = session.model_variance[k];
  if (!std::isfinite(own) || !std::isfinite(session.difference[k])) return std::nullopt;
  // The common estimate holds a share common / model of this one.
  const double apart = std::max(kLeastDifference, 1.0 - common / model);
  return Difference{session.difference[k], own, model, apart * own};
}

/// Variance of a component of the common estimate as the scatter of the sessions shows it: its own
/// by the model, enlarged as those of the sessions are and by chi-square per degree of freedom less
/// one sigma of its scatter. 0 when they do not scatter more than they should.
double ScatterVariance(const std::vector<SessionMarginals>& sessions, int place, double common) {
  double chi2 = 0.0, dof = 0.0, enlargement = 0.0, count = 0.0;
  for (const SessionMarginals& session : sessions) {
    const auto difference = Compare(session, place, common);
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
    const auto difference = Compare(session, k, model(k, k));
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
      const auto compared = Compare(alone, place + k, 0.0);
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

Marginals CoverHalves(Marginals marginals) {
  if (marginals.halves_sigmas <= kDisagreement) return marginals;
  for (Eigen::Index k = 0; k < marginals.halves_difference.size(); ++k)
    marginals.robust(k, k) =
        std::max(marginals.robust(k, k), std::pow(0.5 * marginals.halves_difference[k], 2));
  return marginals;
}

void DoubtResult(const std::vector<PreparedSession>& sessions, Calibration* result) {
  if (!result->IsUsable()) return;
  std::vector<std::string> doubts;
  DoubtHalves(*result, &doubts);
  DoubtNoise(sessions, *result, &doubts);
  DoubtPoseSource(*result, &doubts);
  DoubtFilters(*result, &doubts);
  DoubtSmoothing(sessions, *result, &doubts);
  if (doubts.empty()) return;
  if (result->status == Status::kWeak) doubts.push_back(result->message);
  result->status = Status::kWeak;
  result->message = doubts.front();
  result->warnings.insert(result->warnings.end(), doubts.begin() + 1, doubts.end());
}

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
  if (result->sessions.size() < 2 || !result->IsUsable()) return;
  size_t worst = 0;
  for (size_t s = 1; s < result->sessions.size(); ++s)
    if (result->sessions[s].agreement.sigmas > result->sessions[worst].agreement.sigmas) worst = s;
  const Agreement& agreement = result->sessions[worst].agreement;
  if (agreement.sigmas < kStandsOut) return;
  const std::string who = result->sessions.size() == 2
                              ? "sessions 1 and 2 disagree"
                              : "session " + std::to_string(worst + 1) + " stands out";
  const std::string text =
      who + ": " + agreement.worst + " by " + InWords(agreement.difference, agreement.unit) + ", " +
      Number(agreement.sigmas, "%.1f sigma") + ": did the marker or the imu move?";
  result->message = result->status == Status::kOk ? text : text + "; " + result->message;
  result->status = Status::kWeak;
}

}  // namespace imu_pose_calib
