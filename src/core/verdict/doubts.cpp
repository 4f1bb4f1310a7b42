#include <algorithm>
#include <cmath>
#include <string>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/verdict/verdict.h"

namespace imu_pose_calib {
namespace {

constexpr double kLeastTurning = 3.0;  // [s]
constexpr double kCertain = 2.0;       // sigma of what is there
/// Noise of poses in the solve over that of S1, which is at least the second of these.
constexpr double kIgnored = 10.0;
constexpr PoseStd kOrdinaryNoise{1e-3, 3e-3};  // [m], [rad]
/// Noise of the IMU's sensors in a solve against a given trajectory, over their own.
constexpr double kLost = 1.5;
// Beyond what sources of poses do:
constexpr double kMostScale = 0.012;     // [1]
constexpr double kMostSmoothing = 4e-3;  // [s^2]
/// From which on the second moment is not enough to describe an accelerometer's filter.
constexpr double kMostAccelSmoothing = 1.2e-3;  // [s^2]
constexpr double kMostCompliance = 6.33e-5;     // [s^2] of a mount: 20 Hz, 0.6 mm by its weight

/// How long the imu turns while there are poses, if all of it were as fast: (int w^2)^2 / int w^4,
/// w^2 the mean square of the turn rate in half a second [s].
double TurningTime(const std::vector<PreparedSession>& sessions, size_t imu) {
  constexpr double kBin = 0.5;
  double sum = 0.0, sum2 = 0.0;
  for (const PreparedSession& session : sessions) {
    const std::vector<TimedSample>& gyro = session.data.imus[imu].gyro;
    const auto is_seen = [&](const TimedSample& sample) {
      return session.trajectory->Contains(sample.t + session.starts[imu].time_shift);
    };
    for (size_t i = 0; i < gyro.size();) {
      const double end = gyro[i].t + kBin;
      double square = 0.0, seen = 0.0, count = 0.0;
      for (; i < gyro.size() && gyro[i].t < end; ++i, count += 1.0) {
        if (!is_seen(gyro[i])) continue;
        square += (gyro[i].value - session.starts[imu].gyro_bias).squaredNorm();
        seen += 1.0;
      }
      if (seen == 0.0) continue;
      sum += square / count;
      sum2 += square * square / (seen * count);
    }
  }
  return sum2 > 0.0 ? kBin * sum * sum / sum2 : 0.0;
}

/// Of so few seconds a touch of the markers or a slip of the imu is a part too large, and no other
/// part contradicts it.
void DoubtMotion(const std::vector<PreparedSession>& sessions, const Calibration& result,
                 std::vector<std::string>* doubts) {
  for (size_t i = 0; i < result.imus.size(); ++i) {
    const double time = TurningTime(sessions, i);
    if (time >= kLeastTurning) continue;
    doubts->push_back("nearly all turns" + OfImu(i, result.imus.size()) + " are in " +
                      Number(time, "%.1f") + " s (bound: " + Number(kLeastTurning) +
                      " s): turn it for longer");
  }
}

void DoubtHalves(const Calibration& result, std::vector<std::string>* doubts) {
  if (result.split_half.sigmas <= kAgreementBound) return;
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

/// Of a mount that gives way by so much.
std::string Resonance(double compliance) {
  return Number(0.5 / (M_PI * std::sqrt(compliance)), "%.0f Hz");
}

void DoubtSensors(const Calibration& result, std::vector<std::string>* doubts) {
  for (size_t i = 0; i < result.imus.size(); ++i) {
    const double smoothing = result.imus[i].accel_smoothing;
    if (std::abs(smoothing) > kMostAccelSmoothing)
      doubts->push_back(std::string("the ") + (smoothing > 0.0 ? "accelerometer" : "gyroscope") +
                        OfImu(i, result.imus.size()) + " averages over " +
                        InWords(std::sqrt(std::abs(smoothing)), "s") + " more than the " +
                        (smoothing > 0.0 ? "gyroscope" : "accelerometer") +
                        " (bound: " + InWords(std::sqrt(kMostAccelSmoothing), "s") +
                        "), and what that does to fast motion is undone in part only: set a faster "
                        "filter, or move slowly");
    const auto [compliance, sigma] = result.imus[i].Compliance();
    if (compliance > std::max(kMostCompliance, kCertain * sigma))
      doubts->push_back("the mount of the imu" + OfImu(i, result.imus.size()) +
                        " is soft: it resonates at some " + Resonance(compliance) +
                        " (bound: " + Resonance(kMostCompliance) + ") and gives way by " +
                        InWords(result.sessions[0].g_W.norm() * compliance, "m") +
                        " to the imu's weight; the result is that without load. Fasten the imu");
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
                             double found, const char* unit) {
        const double own = OwnNoise(samples);
        if (found <= kLost * own) return;
        doubts->push_back("method gp does not follow the motion" + OfSession(s, sessions.size()) +
                          ": it leaves the " + name + OfImu(i, result.imus.size()) +
                          " a noise of " + Number(found, "%.3g") + " " + unit + ", its own is " +
                          Number(own, "%.3g") + ", and p_MI is too short or too long: use joint");
      };
      const auto& noise = result.sessions[s].imus[i].noise;
      check("accelerometer", imu.accel, noise.accel, "m/s^2");
      check("gyroscope", imu.gyro, noise.gyro, "rad/s");
    }
  }
}

}  // namespace

Marginals CoverHalves(Marginals marginals) {
  if (marginals.halves_sigmas <= kAgreementBound) return marginals;
  for (Eigen::Index k = 0; k < marginals.halves_difference.size(); ++k)
    marginals.robust(k, k) =
        std::max(marginals.robust(k, k), std::pow(0.5 * marginals.halves_difference[k], 2));
  return marginals;
}

void DoubtResult(const std::vector<PreparedSession>& sessions, bool has_settled,
                 Calibration* result) {
  if (!result->IsUsable()) return;
  std::vector<std::string> doubts;
  DoubtMotion(sessions, *result, &doubts);
  if (!has_settled)
    doubts.emplace_back("the solve has not settled: the result may move by parts of its sigma");
  DoubtHalves(*result, &doubts);
  DoubtNoise(sessions, *result, &doubts);
  DoubtPoseSource(*result, &doubts);
  DoubtSensors(*result, &doubts);
  DoubtSmoothing(sessions, *result, &doubts);
  if (doubts.empty()) return;
  if (result->status == Status::kWeak) doubts.push_back(result->message);
  result->status = Status::kWeak;
  result->message = doubts.front();
  result->warnings.insert(result->warnings.end(), doubts.begin() + 1, doubts.end());
}

}  // namespace imu_pose_calib
