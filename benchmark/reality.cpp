// Errors over simulated recordings that have what real ones have.
//
//   reality [SEEDS = 10] [CAMPAIGN = 300] [FIRST = 1]
//   reality --campaign-seed K
//   reality --dump COUNT FIRST
//
// A row for each effect alone, at its usual strength, on SEEDS recordings; then a campaign of
// recordings FIRST, FIRST + 1, ... that are random mixtures of motions, rates, noises and effects,
// of which it prints those that are wrong and called ok, refused, or too much for it. The second
// form looks at one of them: as it is, and without each of its effects.

#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <future>
#include <map>
#include <mutex>
#include <random>
#include <sstream>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

constexpr double kWrongSigmas = 5.0, kWrong = 1e-3;  // [m] both exceeded by an error of p: wrong
constexpr double kShare = 0.15;                      // of the mixtures that have an effect
constexpr double kLeast = 1.0 / 3.0, kMost = 2.0;    // strength in mixtures, of the usual one
constexpr size_t kBlock = 20;                        // recordings of the campaign between outputs
constexpr rlim_t kTimeLimit = 90;                    // [s] of a processor, for one recording
constexpr rlim_t kMemoryLimit = 4ull << 30;          // [bytes]

/// What became of one recording.
struct Outcome {
  std::string verdict = "failed";                ///< or "ok", "weak", "degenerate", "refused"
  std::string reason = "died or took too long";  ///< message of the result or the refusal
  // Of usable results:
  double p = 0.0;           ///< [m] norm of the error
  double R = 0.0;           ///< [rad]
  double time_shift = 0.0;  ///< [s]
  double sigmas = 0.0;      ///< largest error of p along an axis
  double p_std = 0.0;       ///< [m] norm of the reported sigma
  std::string warnings;     ///< one a line

  bool IsUsable() const { return verdict == "ok" || verdict == "weak"; }
  bool IsWrong() const { return IsUsable() && sigmas > kWrongSigmas && p > kWrong; }
};

Outcome Run(const SimulatorOptions& truth) {
  CalibrationOptions options;
  options.num_threads = 1;
  Outcome outcome;
  try {
    const Calibration result = Calibrate(options, Simulate(truth));
    const Rigid3& T = result.imus[0].T_MI;
    const Eigen::Vector3d p = T.p - truth.T_MI.p, std = result.imus[0].Std().head<3>();
    outcome.verdict = ToString(result.status);
    outcome.reason = result.message;
    for (const std::string& warning : result.warnings)
      outcome.warnings += "warning: " + warning + "\n";
    outcome.p = p.norm();
    outcome.R = truth.T_MI.q.angularDistance(T.q);
    outcome.time_shift = result.sessions[0].imus[0].time_shift - TrueClock(truth).time_shift_s;
    outcome.sigmas = p.cwiseQuotient(std).cwiseAbs().maxCoeff();
    outcome.p_std = std.norm();
  } catch (const DataError& error) {
    outcome.verdict = "refused";
    outcome.reason = error.what();
  } catch (const std::exception& error) {
    outcome.reason = error.what();
  }
  return outcome;
}

/// Run() in a process of its own, which may die or take too much.
Outcome RunApart(const SimulatorOptions& truth) {
  static std::mutex mutex;  // no child holds the end of another one's pipe
  std::unique_lock<std::mutex> lock(mutex);
  int ends[2];
  if (pipe(ends) != 0) throw std::runtime_error("no pipe");
  const pid_t child = fork();
  if (child < 0) throw std::runtime_error("no process");
  if (child == 0) {
    const rlimit time{kTimeLimit, kTimeLimit}, memory{kMemoryLimit, kMemoryLimit};
    setrlimit(RLIMIT_CPU, &time);
    setrlimit(RLIMIT_AS, &memory);
    const Outcome outcome = Run(truth);
    std::ostringstream text;
    text.precision(17);
    text << outcome.p << " " << outcome.R << " " << outcome.time_shift << " " << outcome.sigmas
         << " " << outcome.p_std << " " << outcome.verdict << "\n"
         << outcome.reason << "\n"
         << outcome.warnings;
    const std::string all = text.str();
    _exit(write(ends[1], all.data(), all.size()) < 0 ? 1 : 0);
  }
  close(ends[1]);
  lock.unlock();
  std::string all;
  char buffer[4096];
  for (ssize_t size; (size = read(ends[0], buffer, sizeof(buffer))) > 0;)
    all.append(buffer, static_cast<size_t>(size));
  close(ends[0]);
  waitpid(child, nullptr, 0);

  Outcome outcome;
  if (all.empty()) return outcome;
  std::istringstream text(all);
  for (double* number :
       {&outcome.p, &outcome.R, &outcome.time_shift, &outcome.sigmas, &outcome.p_std}) {
    std::string word;  // may be nan
    text >> word;
    *number = std::atof(word.c_str());
  }
  text >> outcome.verdict;
  std::getline(text.ignore(), outcome.reason);
  std::getline(text, outcome.warnings, '\0');
  return outcome;
}

/// RunApart() of all, on all processors.
std::vector<Outcome> RunAll(const std::vector<SimulatorOptions>& truths) {
  std::vector<Outcome> outcomes(truths.size());
  std::atomic<size_t> next{0};
  const auto work = [&] {
    for (size_t i = next++; i < truths.size(); i = next++) outcomes[i] = RunApart(truths[i]);
  };
  std::vector<std::future<void>> workers;
  for (unsigned i = 0; i < std::max(1u, std::thread::hardware_concurrency()); ++i)
    workers.push_back(std::async(std::launch::async, work));
  for (std::future<void>& worker : workers) worker.get();
  return outcomes;
}

/// NaN of nothing.
double Quantile(std::vector<double> values, double share) {
  if (values.empty()) return NAN;
  std::sort(values.begin(), values.end());
  return values[static_cast<size_t>(share * static_cast<double>(values.size() - 1) + 0.5)];
}

std::string Shortened(const std::string& text, size_t size) {
  return text.size() <= size ? text : text.substr(0, size - 3) + "...";
}

/// "vibration 2, imu-burst 5".
std::string Named(SimulatorOptions options) {
  std::string text;
  for (const Effect& effect : Effects(&options)) {
    const double strength = *effect.strength;
    if (strength == 0.0) continue;
    char number[32];
    std::snprintf(number, sizeof(number), " %.2g", strength);
    text += (text.empty() ? "" : ", ") + std::string(effect.name) + number;
  }
  return text.empty() ? "no effects" : text;
}

// --- Table ---

void PrintHeader() {
  std::printf("%-24s%9s%9s%9s%9s%9s%9s  %s\n%-24s%9s%9s%9s%9s%9s%9s  %s\n", "", "p", "R", "shift",
              "sigma p", "p/sigma", "p/sigma", "verdicts", "", "mm rms", "deg rms", "ms rms",
              "mm rms", "median", "90 %", "");
}

void PrintRow(const std::string& name, const std::vector<Outcome>& outcomes) {
  double p = 0.0, R = 0.0, shift = 0.0, variance = 0.0;
  std::vector<double> sigmas;
  std::map<std::string, int> verdicts;
  std::string reason;
  for (const Outcome& outcome : outcomes) {
    ++verdicts[outcome.verdict];
    if (!outcome.IsUsable()) {
      if (reason.empty()) reason = ": " + Shortened(outcome.reason, 90);
      continue;
    }
    p += outcome.p * outcome.p;
    R += outcome.R * outcome.R;
    shift += outcome.time_shift * outcome.time_shift;
    variance += outcome.p_std * outcome.p_std;
    sigmas.push_back(outcome.sigmas);
  }
  const auto rms = [&](double sum) { return std::sqrt(sum / static_cast<double>(sigmas.size())); };
  std::printf("%-24s", name.c_str());
  if (sigmas.empty())
    std::printf("%56s", "");
  else
    std::printf("%9.3f%9.4f%9.4f%9.3f%9.2f%9.2f  ", 1e3 * rms(p), 180.0 / M_PI * rms(R),
                1e3 * rms(shift), 1e3 * rms(variance), Quantile(sigmas, 0.5),
                Quantile(sigmas, 0.9));
  const char* separator = "";
  for (const char* verdict : {"ok", "weak", "degenerate", "refused", "failed"}) {
    if (verdicts[verdict] == 0) continue;
    std::printf("%s%d %s", separator, verdicts[verdict], verdict);
    separator = ", ";
  }
  std::printf("%s\n", reason.c_str());
  std::fflush(stdout);
}

SimulatorOptions Baseline() {
  SimulatorOptions truth;
  truth.duration_s = 60.0;
  truth.position_std = 0.3e-3;
  truth.accel_delay_s = 2e-3;
  return truth;
}

void PrintRow(const std::string& name, SimulatorOptions truth, unsigned seeds) {
  std::vector<SimulatorOptions> truths;
  for (truth.seed = 3001; truth.seed <= 3000 + seeds; ++truth.seed) truths.push_back(truth);
  PrintRow(name, RunAll(truths));
}

void CompareEffects(unsigned seeds) {
  std::printf("%u recordings each\n", seeds);
  PrintHeader();
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble, Motion::kArm, Motion::kDrone}) {
    SimulatorOptions truth = Baseline();
    truth.motion = motion;
    PrintRow(ToString(motion), truth, seeds);
  }
  SimulatorOptions truth = Baseline();
  for (const Effect& effect : Effects(&truth)) {
    *effect.strength = effect.usual;
    PrintRow(Named(truth), truth, seeds);
    *effect.strength = 0.0;
  }
}

// --- Campaign ---

SimulatorOptions Mixture(uint32_t seed) {
  std::seed_seq sequence{seed, 4001u};
  std::mt19937 random(sequence);
  const auto uniform = [&](double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(random);
  };
  const auto log_uniform = [&](double low, double high) {
    return std::exp(uniform(std::log(low), std::log(high)));
  };
  const Motion motions[] = {Motion::kHandheld, Motion::kHandheld, Motion::kTumble, Motion::kArm,
                            Motion::kDrone};
  SimulatorOptions truth;
  truth.seed = 4000 + seed;
  truth.motion = motions[static_cast<size_t>(uniform(0.0, 5.0))];
  truth.duration_s = uniform(30.0, 80.0);
  truth.pose_rate_hz = std::round(log_uniform(30.0, 200.0));
  truth.gyro_rate_hz = truth.accel_rate_hz = std::round(log_uniform(100.0, 500.0));
  truth.position_std = log_uniform(0.1e-3, 3e-3);
  truth.rotation_std = log_uniform(0.3e-3, 5e-3);
  truth.gyro_std = log_uniform(1e-3, 1e-2);
  truth.accel_std = log_uniform(1e-2, 1e-1);
  truth.T_MI.p = log_uniform(0.03, 0.4) * RandomDirection(&random);
  truth.T_MI.q = Exp<double>(uniform(0.0, M_PI) * RandomDirection(&random));
  truth.gyro_bias = Gaussian(&random, 0.01);
  truth.accel_bias = Gaussian(&random, 0.1);
  truth.time_shift_s = uniform(-1.0, 1.0) * log_uniform(1e-2, 1e4);
  truth.accel_delay_s = uniform(-3e-3, 5e-3);
  for (const Effect& effect : Effects(&truth)) {
    const bool is_there = uniform(0.0, 1.0) < kShare, is_negative = uniform(0.0, 1.0) < 0.5;
    double strength = effect.usual * log_uniform(kLeast, kMost);
    if (effect.least < 0.0 && is_negative) strength = -strength;
    if (effect.unit == std::string("N")) strength = std::max(2.0, std::round(strength));
    if (is_there) *effect.strength = strength;
  }
  return truth;
}

std::string Describe(const SimulatorOptions& truth) {
  char text[200];
  std::snprintf(
      text, sizeof(text),
      "%s %.0f s, %.0f/%.0f Hz, %.2g mm, %.2g mrad, %.2g rad/s, %.2g m/s^2, lever %.2g m: ",
      ToString(truth.motion), truth.duration_s, truth.pose_rate_hz, truth.gyro_rate_hz,
      1e3 * truth.position_std, 1e3 * truth.rotation_std, truth.gyro_std, truth.accel_std,
      truth.T_MI.p.norm());
  return text + Named(truth);
}

void RunCampaign(size_t count, uint32_t first) {
  std::printf("\n%zu mixtures\n", count);
  std::map<std::string, int> verdicts, wrong;
  std::vector<double> sigmas;
  for (size_t done = 0; done < count; done += kBlock) {
    std::vector<SimulatorOptions> truths;
    for (size_t i = done; i < std::min(count, done + kBlock); ++i)
      truths.push_back(Mixture(first + static_cast<uint32_t>(i)));
    const std::vector<Outcome> outcomes = RunAll(truths);
    for (size_t i = 0; i < outcomes.size(); ++i) {
      const Outcome& outcome = outcomes[i];
      ++verdicts[outcome.verdict];
      if (outcome.IsUsable()) sigmas.push_back(outcome.sigmas);
      if (outcome.IsWrong()) ++wrong[outcome.verdict];
      const size_t seed = first + done + i;
      if (outcome.IsWrong() && outcome.verdict == "ok")
        std::printf("%5zu wrong: p off by %.1f mm, %.1f sigma: %s\n", seed, 1e3 * outcome.p,
                    outcome.sigmas, Describe(truths[i]).c_str());
      if (!outcome.IsUsable())
        std::printf("%5zu %s: %s\n      %s\n", seed, outcome.verdict.c_str(),
                    Describe(truths[i]).c_str(), Shortened(outcome.reason, 150).c_str());
    }
    std::fflush(stdout);
  }
  std::printf(
      "%d ok, of which %d wrong; %d weak, of which %d wrong; %d degenerate; %d refused; %d failed\n"
      "largest error of p by its sigma: median %.2f, 90 %% %.2f\n",
      verdicts["ok"], wrong["ok"], verdicts["weak"], wrong["weak"], verdicts["degenerate"],
      verdicts["refused"], verdicts["failed"], Quantile(sigmas, 0.5), Quantile(sigmas, 0.9));
}

/// For benchmark/ablation.py: mixtures, plain recordings of all motions that move, and each effect
/// alone, one a row: seed, verdict, errors of p [mm] and R [mrad], largest error [sigma], sigma of
/// p [mm].
void Dump(size_t count, uint32_t first) {
  constexpr uint32_t kPlain = 1000000, kAlone = 2000000;
  std::vector<SimulatorOptions> truths;
  std::vector<uint32_t> seeds;
  for (uint32_t i = 0; i < count; ++i) {
    seeds.push_back(first + i);
    truths.push_back(Mixture(first + i));
  }
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble, Motion::kArm, Motion::kDrone}) {
    for (uint32_t k = 0; k < 4; ++k) {
      SimulatorOptions truth = Baseline();
      truth.motion = motion;
      truth.seed = 7001 + k;
      if (k % 2 == 1) truth.position_std = truth.rotation_std = 5e-3;
      seeds.push_back(kPlain + static_cast<uint32_t>(truths.size()));
      truths.push_back(truth);
    }
  }
  // Each effect alone, at its usual strength and at twice of it.
  SimulatorOptions alone = Baseline();
  for (const Effect& effect : Effects(&alone)) {
    for (const double times : {1.0, 2.0}) {
      *effect.strength = times * effect.usual;
      alone.seed = 7001 + static_cast<uint32_t>(truths.size());
      seeds.push_back(kAlone + static_cast<uint32_t>(truths.size()));
      truths.push_back(alone);
    }
    *effect.strength = 0.0;
  }
  const std::vector<Outcome> outcomes = RunAll(truths);
  for (size_t i = 0; i < outcomes.size(); ++i)
    std::printf("%u %s %.6g %.6g %.4g %.6g\n", seeds[i], outcomes[i].verdict.c_str(),
                1e3 * outcomes[i].p, 1e3 * outcomes[i].R, outcomes[i].sigmas,
                1e3 * outcomes[i].p_std);
}

/// One mixture, and the same without each of its effects and without all.
void LookAt(uint32_t seed) {
  const SimulatorOptions mixture = Mixture(seed);
  std::vector<std::string> names = {"as it is", "without effects"};
  std::vector<SimulatorOptions> truths = {mixture, mixture};
  SimulatorOptions without = mixture;
  for (const Effect& effect : Effects(&without)) {
    const double strength = std::exchange(*effect.strength, 0.0);
    if (strength != 0.0) {
      truths.push_back(without);
      names.push_back(std::string("- ") + effect.name);
    }
    *effect.strength = strength;
  }
  for (const Effect& effect : Effects(&truths[1])) *effect.strength = 0.0;
  const std::vector<Outcome> outcomes = RunAll(truths);
  std::printf("%s\n%s\n%s", Describe(mixture).c_str(), outcomes[0].reason.c_str(),
              outcomes[0].warnings.c_str());
  PrintHeader();
  for (size_t i = 0; i < outcomes.size(); ++i) PrintRow(names[i], {outcomes[i]});
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  if (argc == 3 && argv[1] == std::string("--campaign-seed")) {
    imu_pose_calib::LookAt(static_cast<uint32_t>(std::atoi(argv[2])));
    return 0;
  }
  if (argc == 4 && argv[1] == std::string("--dump")) {
    imu_pose_calib::Dump(static_cast<size_t>(std::atoi(argv[2])),
                         static_cast<uint32_t>(std::atoi(argv[3])));
    return 0;
  }
  const int seeds = argc > 1 ? std::atoi(argv[1]) : 10;
  const int campaign = argc > 2 ? std::atoi(argv[2]) : 300;
  const int first = argc > 3 ? std::atoi(argv[3]) : 1;
  if (seeds < 0 || campaign < 0 || first < 0 || (argc > 1 && argv[1][0] == '-')) {
    std::fprintf(stderr,
                 "usage: reality [SEEDS] [CAMPAIGN] [FIRST]\n       reality --campaign-seed K\n");
    return 1;
  }
  if (seeds > 0) imu_pose_calib::CompareEffects(static_cast<unsigned>(seeds));
  if (campaign > 0)
    imu_pose_calib::RunCampaign(static_cast<size_t>(campaign), static_cast<uint32_t>(first));
}
