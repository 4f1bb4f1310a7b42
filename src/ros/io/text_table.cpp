#include "imu_pose_calib/ros/io/text_table.h"

#include <algorithm>
#include <array>
#include <boost/algorithm/string.hpp>
#include <boost/lexical_cast/try_lexical_convert.hpp>
#include <boost/multiprecision/cpp_dec_float.hpp>
#include <cmath>
#include <optional>
#include <stdexcept>
#include <utility>

#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

using Strings = std::vector<std::string>;

// --- Columns ---

/// A column that is needed: its name, and all that headers may call it, in lower case.
struct Column {
  std::string name;
  Strings aliases;
};
/// The first one holds the stamps.
using Columns = std::vector<Column>;

/// The stamps, and for each axis of each group a column that any of the prefixes may begin.
Columns MakeColumns(const std::vector<std::pair<std::string, Strings>>& groups) {
  Columns columns{{"timestamp", {"timestamp", "time", "stamp", "t"}}};
  for (const auto& [axes, prefixes] : groups) {
    for (const char axis : axes) {
      Column column{prefixes[0] + axis, {}};
      for (const std::string& prefix : prefixes) column.aliases.push_back(prefix + axis);
      columns.push_back(column);
    }
  }
  return columns;
}

const Strings kGyroPrefixes{"g", "gyro_", "w", "w_", "w_rs_s_", "omega_", "angular_velocity_"};
const Strings kAccelPrefixes{"a", "a_", "a_rs_s_", "acc_", "accel_", "linear_acceleration_"};

Columns PoseColumns() {
  return MakeColumns({{"xyz", {"t", "", "p", "p_", "p_rs_r_", "pos_", "position_"}},
                      {"xyzw", {"q", "q_", "q_rs_", "quat_", "orientation_"}}});
}

Columns ImuColumns() { return MakeColumns({{"xyz", kGyroPrefixes}, {"xyz", kAccelPrefixes}}); }

/// A file of one sensor may call its columns x, y, z.
Columns SensorColumns(Strings prefixes) {
  prefixes.emplace_back("");
  return MakeColumns({{"xyz", prefixes}});
}

std::string Names(const Columns& columns) {
  std::string names;
  for (const Column& column : columns) names += (names.empty() ? "" : " ") + column.name;
  return names;
}

// --- Lines ---

/// Text from a file for a message: short and printable.
std::string Quote(const std::string& text) {
  constexpr size_t kMaxSize = 60;
  std::string quoted = text.substr(0, kMaxSize);
  for (char& c : quoted)
    if (c < ' ' || c > '~') c = '.';
  return "'" + quoted + (text.size() > kMaxSize ? "...'" : "'");
}

/// The lines of a text with their numbers, without blanks at both ends.
class Lines {
 public:
  Lines(std::istream& in, std::string name) : in_(in), name_(std::move(name)) {}

  bool Next(std::string* line) {
    in_.getline(buffer_.data(), buffer_.size());
    if (in_.bad()) Fail("cannot be read");
    const auto size = static_cast<size_t>(in_.gcount());
    if (in_.fail() && size == 0) return false;
    ++number_;
    if (in_.fail())
      FailHere("has more than " + std::to_string(size) + " characters: not a table of samples");
    line->assign(buffer_.data(), in_.eof() ? size : size - 1);
    if (line->find('\0') != std::string::npos) FailHere("is not text");
    if (number_ == 1 && boost::starts_with(*line, "\xEF\xBB\xBF")) line->erase(0, 3);
    boost::trim(*line);
    return true;
  }

  size_t number() const { return number_; }

  [[noreturn]] void Fail(const std::string& text) const {
    throw InputError("'" + name_ + "': " + text);
  }
  [[noreturn]] void FailAt(size_t number, const std::string& text) const {
    Fail("line " + std::to_string(number) + " " + text);
  }
  [[noreturn]] void FailHere(const std::string& text) const { FailAt(number_, text); }

 private:
  std::istream& in_;
  std::string name_;
  size_t number_ = 0;
  std::array<char, 16384> buffer_;
};

Strings Split(const std::string& line) {
  Strings fields;
  const char* separator = boost::contains(line, ";") ? ";" : boost::contains(line, ",") ? "," : "";
  if (*separator != '\0') {
    boost::split(fields, line, boost::is_any_of(separator));
  } else {
    boost::split(fields, line, boost::is_space(), boost::token_compress_on);
  }
  for (std::string& field : fields) boost::trim(field);
  return fields;
}

// --- Header ---

/// Number of nanoseconds in a unit of time; 0: unknown unit.
int64_t Nanoseconds(const std::string& unit) {
  if (unit == "s") return 1'000'000'000;
  if (unit == "ms") return 1'000'000;
  if (unit == "us") return 1'000;
  if (unit == "ns") return 1;
  return 0;
}

/// A column as a header gives it: "timestamp [ns]".
struct HeaderField {
  std::string name, unit;
};

std::vector<HeaderField> SplitHeader(const std::string& line) {
  // Blanks may separate columns, but not a name from its unit.
  std::string joined;
  bool in_unit = false;
  for (const char c : boost::trim_left_copy_if(line, boost::is_any_of("# \t"))) {
    if (c == '[') boost::trim_right(joined);
    in_unit = c == '[' || (in_unit && c != ']');
    if (!in_unit || !boost::is_space()(c)) joined += c;
  }
  std::vector<HeaderField> header;
  for (const std::string& field : Split(joined)) {
    const size_t bracket = std::min(field.find('['), field.size());
    header.push_back({field.substr(0, bracket),
                      boost::trim_copy_if(field.substr(bracket), boost::is_any_of("[]"))});
  }
  return header;
}

/// Indices in `header` of the fields that fit a column.
std::vector<size_t> Find(const Column& column, const std::vector<HeaderField>& header) {
  std::vector<size_t> found;
  for (size_t i = 0; i < header.size(); ++i) {
    const Strings& names = column.aliases;
    if (std::count(names.begin(), names.end(), boost::to_lower_copy(header[i].name)) > 0)
      found.push_back(i);
  }
  return found;
}

/// A comment is a header when it names the stamps and more of the columns.
bool IsHeader(const Columns& columns, const std::string& comment) {
  const std::vector<HeaderField> header = SplitHeader(comment);
  return !Find(columns[0], header).empty() &&
         std::any_of(columns.begin() + 1, columns.end(),
                     [&](const Column& column) { return !Find(column, header).empty(); });
}

/// Where the columns are in a line, and what the file calls them.
struct Layout {
  std::vector<size_t> index;  ///< of each column
  Strings names;              ///< of each column
  size_t width = 0;           ///< fields in a line
  std::string time_unit;      ///< empty: not given
};

/// A line that may be a header.
struct NumberedLine {
  std::string text;
  size_t number = 0;
};

Layout ReadHeader(const Columns& columns, const NumberedLine& line, const Lines& lines) {
  const std::vector<HeaderField> header = SplitHeader(line.text);
  const auto fail = [&](const std::string& text) {
    lines.FailAt(line.number, "is no header: " + Quote(line.text) + " " + text);
  };
  Layout layout;
  for (const Column& column : columns) {
    const std::vector<size_t> found = Find(column, header);
    if (found.empty())
      fail("has no column " + column.name + " (" + boost::join(column.aliases, ", ") +
           "); columns needed: " + Names(columns));
    if (found.size() > 1)
      fail("has the column " + column.name + " twice, as " + Quote(header[found[0]].name) +
           " and " + Quote(header[found[1]].name));
    layout.index.push_back(found[0]);
    layout.names.push_back(header[found[0]].name);
  }
  layout.width = header.size();
  layout.time_unit = header[layout.index[0]].unit;
  if (!layout.time_unit.empty() && Nanoseconds(layout.time_unit) == 0)
    fail("has the stamps in " + Quote(layout.time_unit) + ", must be s, ms, us or ns");
  return layout;
}

// --- Values ---

std::optional<double> ParseNumber(const std::string& text) {
  double value = 0.0;
  if (!boost::conversion::try_lexical_convert(text, value)) return std::nullopt;
  return value;
}

bool IsWhole(const std::string& number) { return number.find_first_of(".eE") == std::string::npos; }

/// Stamps beyond would not leave room for differences: year 2115.
constexpr double kMaxStampNs = 4.6e18;

/// The samples of one table.
class TableReader {
 public:
  TableReader(const Columns& columns, std::istream& in, const std::string& name)
      : columns_(columns), lines_(in, name) {}

  /// Calls `use(t_ns, values)` for every sample, with the values of all columns but the first.
  template <typename Use>
  void ForEach(Use use) {
    std::vector<double> values(columns_.size() - 1);
    size_t count = 0;
    std::string line;
    while (NextSample(&line)) {
      const Strings fields = Split(line);
      if (fields.size() != layout_->width)
        lines_.FailHere("has " + std::to_string(fields.size()) + " columns, must have " +
                        std::to_string(layout_->width) +
                        (has_header_ ? " as the header" : ": " + Names(columns_)));
      const int64_t t_ns = ParseStamp(fields[layout_->index[0]]);
      for (size_t i = 0; i < values.size(); ++i)
        values[i] = ParseValue(i + 1, fields[layout_->index[i + 1]]);
      use(t_ns, values);
      first_ns_ = count == 0 ? t_ns : std::min(first_ns_, t_ns);
      last_ns_ = count == 0 ? t_ns : std::max(last_ns_, t_ns);
      ++count;
    }
    if (count == 0) lines_.Fail("holds no samples");
    CheckUnit(count);
  }

 private:
  /// The next line that is neither empty nor a comment nor the header.
  bool NextSample(std::string* line) {
    while (lines_.Next(line)) {
      if (line->empty()) continue;
      const bool is_comment = (*line)[0] == '#';
      if (layout_ && !is_comment) return true;
      if (layout_) continue;
      if (is_comment) {  // of these the header is kept, else the last one
        if (IsHeader(columns_, *line) || !IsHeader(columns_, comment_.text))
          comment_ = {*line, lines_.number()};
      } else if (!ParseNumber(Split(*line)[0])) {
        SetHeader({*line, lines_.number()});
      } else {
        FindLayout(*line);
        return true;
      }
    }
    return false;
  }

  void SetHeader(const NumberedLine& line) {
    layout_ = ReadHeader(columns_, line, lines_);
    has_header_ = true;
  }

  /// Layout of a table that starts with `sample`. A comment of as many words is taken for a header
  /// too, so that one with unknown names is refused and not overlooked.
  void FindLayout(const std::string& sample) {
    const bool has_header =
        IsHeader(columns_, comment_.text) ||
        (!comment_.text.empty() && SplitHeader(comment_.text).size() == Split(sample).size());
    if (has_header) return SetHeader(comment_);
    layout_.emplace();
    for (const Column& column : columns_) {
      layout_->index.push_back(layout_->width++);
      layout_->names.push_back(column.name);
    }
  }

  /// Refuses the value of a column of the current line.
  [[noreturn]] void FailValue(size_t column, const std::string& text,
                              const std::string& expected) const {
    lines_.FailHere("column " + layout_->names[column] + " is " +
                    (text.empty() ? "empty" : Quote(text)) + ", must be " + expected);
  }

  int64_t ParseStamp(const std::string& text) {
    const std::optional<double> rough = ParseNumber(text);
    if (!rough || !std::isfinite(*rough)) FailValue(0, text, "a number");
    std::string unit = layout_->time_unit;
    if (unit.empty()) {
      const bool is_ns = IsWhole(text) && std::abs(*rough) > 1e15;
      unit = is_ns ? "ns" : "s";
      may_lack_unit_ = may_lack_unit_ && IsWhole(text) && !is_ns;
    }
    const auto scale = static_cast<double>(Nanoseconds(unit));
    if (!(std::abs(*rough) <= kMaxStampNs / scale))
      FailValue(0, text,
                "within " + YamlNumber(kMaxStampNs / scale) + " " + unit +
                    " of 0; a header may name its unit: 'timestamp [ns]'");
    using Decimal = boost::multiprecision::cpp_dec_float_50;
    try {
      return round(Decimal(text) * scale).convert_to<int64_t>();
    } catch (const std::runtime_error&) {  // an exponent out of its range, as in 0e99999999999
      FailValue(0, text, "a number");
    }
  }

  double ParseValue(size_t column, const std::string& text) const {
    const std::optional<double> value = ParseNumber(text);
    if (!value) FailValue(column, text, "a number within +-1.8e308 (nan: lost sample)");
    return *value;
  }

  /// Whole stamps a second or more apart are hardly seconds.
  void CheckUnit(size_t count) const {
    if (!layout_->time_unit.empty() || !may_lack_unit_ || count < 2) return;
    const double period_s =
        1e-9 * static_cast<double>(last_ns_ - first_ns_) / static_cast<double>(count - 1);
    if (period_s >= 1.0)
      lines_.Fail("as seconds, the stamps are " + YamlNumber(period_s) +
                  " s apart; name their unit in a header: 'timestamp [us]'");
  }

  const Columns columns_;
  Lines lines_;
  NumberedLine comment_;
  std::optional<Layout> layout_;
  bool has_header_ = false;
  bool may_lack_unit_ = true;
  int64_t first_ns_ = 0, last_ns_ = 0;
};

Eigen::Vector3d Vector(const std::vector<double>& values, size_t begin) {
  return {values[begin], values[begin + 1], values[begin + 2]};
}

std::vector<ImuSample> ReadSensorTable(const Columns& columns, std::istream& in,
                                       const std::string& name) {
  std::vector<ImuSample> samples;
  TableReader(columns, in, name).ForEach([&](int64_t t_ns, const std::vector<double>& values) {
    samples.push_back({t_ns, Vector(values, 0)});
  });
  return samples;
}

bool StartsWithHeader(const Columns& columns, std::istream& in, const std::string& name) {
  std::string line;
  if (!Lines(in, name).Next(&line)) return false;
  const std::vector<HeaderField> header = SplitHeader(line);
  return std::all_of(columns.begin(), columns.end(),
                     [&](const Column& c) { return !Find(c, header).empty(); });
}

}  // namespace

bool HasPoseHeader(std::istream& in, const std::string& name) {
  return StartsWithHeader(PoseColumns(), in, name);
}

bool HasImuHeader(std::istream& in, const std::string& name) {
  return StartsWithHeader(ImuColumns(), in, name);
}

std::vector<PoseSample> ReadPoseTable(std::istream& in, const std::string& name) {
  std::vector<PoseSample> poses;
  TableReader(PoseColumns(), in, name).ForEach([&](int64_t t_ns, const std::vector<double>& v) {
    poses.push_back({t_ns, {v[6], v[3], v[4], v[5]}, Vector(v, 0), {}});
  });
  return poses;
}

void ReadImuTable(std::istream& in, const std::string& name, ImuData* data) {
  TableReader(ImuColumns(), in, name).ForEach([&](int64_t t_ns, const std::vector<double>& v) {
    data->gyro.push_back({t_ns, Vector(v, 0)});
    data->accel.push_back({t_ns, Vector(v, 3)});
  });
}

std::vector<ImuSample> ReadGyroTable(std::istream& in, const std::string& name) {
  return ReadSensorTable(SensorColumns(kGyroPrefixes), in, name);
}

std::vector<ImuSample> ReadAccelTable(std::istream& in, const std::string& name) {
  return ReadSensorTable(SensorColumns(kAccelPrefixes), in, name);
}

}  // namespace imu_pose_calib
