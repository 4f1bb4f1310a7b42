#include "imu_pose_calib/ros/io/text_table.h"

#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <boost/lexical_cast/try_lexical_convert.hpp>
#include <boost/multiprecision/cpp_dec_float.hpp>
#include <cmath>
#include <limits>
#include <map>
#include <stdexcept>
#include <utility>

#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

using Strings = std::vector<std::string>;

constexpr size_t kTooLong = size_t{1} << 20;  // bytes of a line

// --- Columns ---

/// A column that is needed: all that headers may call it, in lower case, the first its name here.
using Column = Strings;
/// The first one holds the stamps.
using Columns = std::vector<Column>;

/// The stamps, and for each axis of each group a column that any of the prefixes may begin.
Columns MakeColumns(const std::vector<std::pair<std::string, Strings>>& groups) {
  Columns columns{{"timestamp", "time", "stamp", "t"}};
  for (const auto& [axes, prefixes] : groups)
    for (const char axis : axes) {
      columns.push_back(prefixes);
      for (std::string& alias : columns.back()) alias += axis;
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

std::string Names(const Columns& columns) {
  Strings names;
  for (const Column& column : columns) names.push_back(column[0]);
  return boost::join(names, " ");
}

// --- Header ---

Strings Split(const std::string& line) {
  Strings fields;
  if (boost::contains(line, ";"))
    boost::split(fields, line, boost::is_any_of(";"));
  else if (boost::contains(line, ","))
    boost::split(fields, line, boost::is_any_of(","));
  else
    boost::split(fields, line, boost::is_space(), boost::token_compress_on);
  for (std::string& field : fields) boost::trim(field);
  return fields;
}

const std::map<std::string, int64_t> kNanoseconds{
    {"s", 1'000'000'000}, {"ms", 1'000'000}, {"us", 1'000}, {"ns", 1}};

/// A line that may be a header, with the columns as it gives them: "timestamp [ns]", or "(ns)".
struct Header {
  struct Field {
    std::string name, unit;
  };
  std::string text;
  size_t number = 0;  ///< of the line; 0: the file has no header
  std::vector<Field> fields;

  Header() = default;
  Header(const std::string& line, size_t line_number) : text(line), number(line_number) {
    // Blanks may separate columns, but not a name from its unit.
    std::string joined;
    bool in_unit = false;
    for (const char given : boost::trim_left_copy_if(line, boost::is_any_of("# \t"))) {
      const char c = given == '(' ? '[' : given == ')' ? ']' : given;
      if (c == '[') boost::trim_right(joined);
      in_unit = c == '[' || (in_unit && c != ']');
      if (!in_unit || !boost::is_space()(c)) joined += c;
    }
    for (const std::string& field : Split(joined)) {
      const size_t bracket = std::min(field.find('['), field.size());
      fields.push_back({field.substr(0, bracket),
                        boost::trim_copy_if(field.substr(bracket), boost::is_any_of("[]"))});
    }
  }

  /// Indices of the fields that fit a column.
  std::vector<size_t> Find(const Column& column) const {
    std::vector<size_t> found;
    for (size_t i = 0; i < fields.size(); ++i)
      if (std::count(column.begin(), column.end(), boost::to_lower_copy(fields[i].name)) > 0)
        found.push_back(i);
    return found;
  }
  bool Has(const Column& column) const { return !Find(column).empty(); }

  /// A comment is a header when it names the stamps and more of the columns.
  bool IsOf(const Columns& columns) const {
    return Has(columns[0]) && std::any_of(columns.begin() + 1, columns.end(),
                                          [&](const Column& column) { return Has(column); });
  }
};

// --- Values ---

/// The samples of one table.
class TableReader {
 public:
  TableReader(const Columns& columns, std::istream& in, const std::string& name)
      : columns_(columns), lines_(in, name) {}

  /// Calls `use(t_ns, values)` for every sample, with the values of all columns but the first.
  template <typename Use>
  void ForEach(Use use) {
    std::vector<double> values(columns_.size() - 1);
    Strings fields;
    size_t count = 0;
    int64_t first_ns = std::numeric_limits<int64_t>::max(), last_ns = -first_ns;
    for (; NextSample(&fields); ++count) {
      if (fields.size() != header_.fields.size())
        lines_.FailHere("has " + std::to_string(fields.size()) + " columns, must have " +
                        std::to_string(header_.fields.size()) +
                        (header_.number > 0 ? " as the header" : ": " + Names(columns_)));
      const int64_t t_ns = ParseStamp(fields[index_[0]]);
      for (size_t i = 0; i < values.size(); ++i)
        values[i] = ParseValue(header_.fields[index_[i + 1]].name, fields[index_[i + 1]]);
      use(t_ns, values);
      first_ns = std::min(first_ns, t_ns);
      last_ns = std::max(last_ns, t_ns);
    }
    if (count == 0) lines_.Fail("holds no samples");
    if (!may_lack_unit_ || count == 1) return;
    const double period_s = Seconds(last_ns - first_ns) / static_cast<double>(count - 1);
    if (are_ns_ ? period_s < 1e-6 : period_s >= 1.0)
      lines_.Fail(std::string("as ") + (are_ns_ ? "nanoseconds" : "seconds") + ", the stamps are " +
                  YamlNumber(period_s) + " s apart; name their unit in a header: 'timestamp [us]'");
  }

 private:
  /// The next line that is neither empty nor a comment nor the header. A comment of as many words
  /// as the first sample is taken for a header too, so that one with unknown names is refused and
  /// not overlooked.
  bool NextSample(Strings* fields) {
    for (std::string line; lines_.Next(&line);) {
      if (line.empty()) continue;
      *fields = Split(line);
      const bool is_comment = line[0] == '#';
      if (!index_.empty()) {
        if (!is_comment) return true;
      } else if (is_comment) {  // the header is kept, else the last one
        const Header comment(line, lines_.number());
        if (comment.IsOf(columns_) || !header_.IsOf(columns_)) header_ = comment;
      } else if (!ParseNumber(fields->front())) {
        FindColumns({line, lines_.number()});
      } else {
        const bool is_header = header_.IsOf(columns_) || header_.fields.size() == fields->size();
        FindColumns(is_header ? header_ : Header(Names(columns_), 0));
        return true;
      }
    }
    return false;
  }

  /// By the header of the table.
  void FindColumns(const Header& header) {
    const auto fail = [&](const std::string& text) {
      lines_.Fail("line " + std::to_string(header.number) + " is no header: " + Quote(header.text) +
                  " " + text);
    };
    for (const Column& column : columns_) {
      const std::vector<size_t> found = header.Find(column);
      if (found.empty())
        fail("has no column " + column[0] + " (" + boost::join(column, ", ") +
             "); columns needed: " + Names(columns_));
      if (found.size() > 1)
        fail("has the column " + column[0] + " twice, as " + Quote(header.fields[found[0]].name) +
             " and " + Quote(header.fields[found[1]].name));
      index_.push_back(found[0]);
    }
    header_ = header;
    may_lack_unit_ = Stamps().unit.empty();
    if (!may_lack_unit_ && kNanoseconds.count(Stamps().unit) == 0)
      fail("has the stamps in " + Quote(Stamps().unit) + ", must be s, ms, us or ns");
  }

  const Header::Field& Stamps() const { return header_.fields[index_[0]]; }

  int64_t ParseStamp(const std::string& text) {
    const std::optional<double> rough = ParseNumber(text);
    if (!rough || !std::isfinite(*rough)) lines_.FailCell(Stamps().name, text, "a number");
    std::string unit = Stamps().unit;
    if (unit.empty()) {
      const bool is_whole = text.find_first_of(".eE") == std::string::npos;
      are_ns_ = is_whole && std::abs(*rough) > 1e15;
      unit = are_ns_ ? "ns" : "s";
      may_lack_unit_ = may_lack_unit_ && is_whole;
    }
    const auto scale = static_cast<double>(kNanoseconds.at(unit));
    if (!(std::abs(*rough) <= kMaxStampNs / scale))
      lines_.FailCell(Stamps().name, text,
                      "within " + YamlNumber(kMaxStampNs / scale) + " " + unit +
                          " of 0; a header may name its unit: 'timestamp [ns]'");
    using Decimal = boost::multiprecision::cpp_dec_float_50;
    try {
      return round(Decimal(text) * scale).convert_to<int64_t>();
    } catch (const std::runtime_error&) {  // an exponent out of its range, as in 0e99999999999
      lines_.FailCell(Stamps().name, text, "a number");
    }
  }

  double ParseValue(const std::string& column, const std::string& text) const {
    const std::optional<double> value = ParseNumber(text);
    if (!value) lines_.FailCell(column, text, "a number within +-1.8e308 (nan: lost sample)");
    return *value;
  }

  const Columns columns_;
  TextLines lines_;
  Header header_;               ///< of the table; before its first sample, what may be one
  std::vector<size_t> index_;   ///< of each column in a line; empty: no header and no sample yet
  bool may_lack_unit_ = false;  ///< whole stamps so far: hardly seconds, if far apart,
  bool are_ns_ = false;         ///< nor nanoseconds, if next to each other
};

}  // namespace

std::string Quote(const std::string& text) {
  constexpr size_t kMaxSize = 60;
  std::string quoted = text.substr(0, kMaxSize);
  for (char& c : quoted)
    if (c < ' ' || c > '~') c = '.';
  return "'" + quoted + (text.size() > kMaxSize ? "...'" : "'");
}

TextLines::TextLines(std::istream& in, std::string name)
    : in_(in), name_(std::move(name)), buffer_(kTooLong, '\0') {}

bool TextLines::Next(std::string* line) {
  in_.getline(buffer_.data(), static_cast<std::streamsize>(buffer_.size()));
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

void TextLines::Fail(const std::string& text) const { Reject("'", name_, "': ", Printable(text)); }

void TextLines::FailCell(const std::string& column, const std::string& text,
                         const std::string& expected) const {
  FailHere("column " + column + " is " + (text.empty() ? "empty" : Quote(text)) + ", must be " +
           expected);
}

std::optional<double> ParseNumber(const std::string& text) {
  double value = 0.0;
  if (!boost::conversion::try_lexical_convert(text, value)) return std::nullopt;
  return value;
}

bool HasHeader(std::istream& in, const std::string& name, bool is_imu) {
  std::string line;
  if (!TextLines(in, name).Next(&line)) return false;
  const Header header(line, 1);
  const Columns columns = is_imu ? ImuColumns() : PoseColumns();
  return std::all_of(columns.begin(), columns.end(),
                     [&](const Column& column) { return header.Has(column); });
}

std::vector<PoseSample> ReadPoseTable(std::istream& in, const std::string& name) {
  std::vector<PoseSample> poses;
  TableReader(PoseColumns(), in, name).ForEach([&](int64_t t_ns, const std::vector<double>& v) {
    poses.push_back({t_ns, {v[6], v[3], v[4], v[5]}, Eigen::Vector3d::Map(v.data()), {}});
  });
  return poses;
}

void ReadImuTable(std::istream& in, const std::string& name, ImuData* data) {
  TableReader(ImuColumns(), in, name).ForEach([&](int64_t t_ns, const std::vector<double>& v) {
    data->gyro.push_back({t_ns, Eigen::Vector3d::Map(v.data())});
    data->accel.push_back({t_ns, Eigen::Vector3d::Map(v.data() + 3)});
  });
}

std::vector<ImuSample> ReadSensorTable(std::istream& in, const std::string& name, bool is_accel) {
  Strings prefixes = is_accel ? kAccelPrefixes : kGyroPrefixes;
  prefixes.emplace_back("");  // a file of one sensor may call its columns x, y, z
  std::vector<ImuSample> samples;
  TableReader(MakeColumns({{"xyz", prefixes}}), in, name)
      .ForEach([&](int64_t t_ns, const std::vector<double>& values) {
        samples.push_back({t_ns, Eigen::Vector3d::Map(values.data())});
      });
  return samples;
}

}  // namespace imu_pose_calib
