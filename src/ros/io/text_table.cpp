#include "imu_pose_calib/ros/io/text_table.h"

#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <boost/lexical_cast/try_lexical_convert.hpp>
#include <boost/multiprecision/cpp_dec_float.hpp>
#include <cmath>
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

/// Where the columns are in a line, and what the file calls them.
struct Layout {
  std::vector<size_t> index;  ///< of each column
  Strings names;              ///< of each column
  size_t width = 0;           ///< fields in a line
  std::string time_unit;      ///< empty: not given
  bool is_from_header = false;
};

Layout ReadHeader(const Columns& columns, const Header& header, const TextLines& lines) {
  const auto fail = [&](const std::string& text) {
    lines.FailAt(header.number, "is no header: " + Quote(header.text) + " " + text);
  };
  Layout layout;
  for (const Column& column : columns) {
    const std::vector<size_t> found = header.Find(column);
    if (found.empty())
      fail("has no column " + column[0] + " (" + boost::join(column, ", ") +
           "); columns needed: " + Names(columns));
    if (found.size() > 1)
      fail("has the column " + column[0] + " twice, as " + Quote(header.fields[found[0]].name) +
           " and " + Quote(header.fields[found[1]].name));
    layout.index.push_back(found[0]);
    layout.names.push_back(header.fields[found[0]].name);
  }
  layout.width = header.fields.size();
  layout.time_unit = header.fields[layout.index[0]].unit;
  if (!layout.time_unit.empty() && kNanoseconds.count(layout.time_unit) == 0)
    fail("has the stamps in " + Quote(layout.time_unit) + ", must be s, ms, us or ns");
  layout.is_from_header = header.number > 0;
  return layout;
}

/// Layout of a table that starts with a sample of so many fields after a comment. A comment of as
/// many words is taken for a header too, so that one with unknown names is refused and not
/// overlooked.
Layout FindLayout(const Columns& columns, const Header& comment, size_t fields,
                  const TextLines& lines) {
  const bool is_header =
      comment.IsOf(columns) || (!comment.text.empty() && comment.fields.size() == fields);
  return ReadHeader(columns, is_header ? comment : Header(Names(columns), 0), lines);
}

// --- Values ---

bool IsWhole(const std::string& number) { return number.find_first_of(".eE") == std::string::npos; }

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
    while (NextSample(&fields)) {
      if (fields.size() != layout_->width)
        lines_.FailHere("has " + std::to_string(fields.size()) + " columns, must have " +
                        std::to_string(layout_->width) +
                        (layout_->is_from_header ? " as the header" : ": " + Names(columns_)));
      const int64_t t_ns = ParseStamp(fields[layout_->index[0]]);
      for (size_t i = 0; i < values.size(); ++i)
        values[i] = ParseValue(i + 1, fields[layout_->index[i + 1]]);
      use(t_ns, values);
      first_ns_ = count_ == 0 ? t_ns : std::min(first_ns_, t_ns);
      last_ns_ = count_ == 0 ? t_ns : std::max(last_ns_, t_ns);
      ++count_;
    }
    if (count_ == 0) lines_.Fail("holds no samples");
    CheckUnit();
  }

 private:
  /// The next line that is neither empty nor a comment nor the header.
  bool NextSample(Strings* fields) {
    for (std::string line; lines_.Next(&line);) {
      if (line.empty()) continue;
      *fields = Split(line);
      if (line[0] != '#') {
        if (layout_) return true;
        if (ParseNumber(fields->front())) {
          layout_ = FindLayout(columns_, comment_, fields->size(), lines_);
          return true;
        }
        layout_ = ReadHeader(columns_, {line, lines_.number()}, lines_);
      } else if (!layout_) {  // of the comments the header is kept, else the last one
        const Header comment(line, lines_.number());
        if (comment.IsOf(columns_) || !comment_.IsOf(columns_)) comment_ = comment;
      }
    }
    return false;
  }

  int64_t ParseStamp(const std::string& text) {
    const std::optional<double> rough = ParseNumber(text);
    if (!rough || !std::isfinite(*rough)) lines_.FailCell(layout_->names[0], text, "a number");
    std::string unit = layout_->time_unit;
    if (unit.empty()) {
      const bool is_ns = IsWhole(text) && std::abs(*rough) > 1e15;
      unit = is_ns ? "ns" : "s";
      may_lack_unit_ = may_lack_unit_ && IsWhole(text) && !is_ns;
    }
    const auto scale = static_cast<double>(kNanoseconds.at(unit));
    if (!(std::abs(*rough) <= kMaxStampNs / scale))
      lines_.FailCell(layout_->names[0], text,
                      "within " + YamlNumber(kMaxStampNs / scale) + " " + unit +
                          " of 0; a header may name its unit: 'timestamp [ns]'");
    using Decimal = boost::multiprecision::cpp_dec_float_50;
    try {
      return round(Decimal(text) * scale).convert_to<int64_t>();
    } catch (const std::runtime_error&) {  // an exponent out of its range, as in 0e99999999999
      lines_.FailCell(layout_->names[0], text, "a number");
    }
  }

  double ParseValue(size_t column, const std::string& text) const {
    const std::optional<double> value = ParseNumber(text);
    if (!value)
      lines_.FailCell(layout_->names[column], text, "a number within +-1.8e308 (nan: lost sample)");
    return *value;
  }

  /// Whole stamps a second or more apart are hardly seconds.
  void CheckUnit() const {
    if (!layout_->time_unit.empty() || !may_lack_unit_ || count_ < 2) return;
    const double period_s = Seconds(last_ns_ - first_ns_) / static_cast<double>(count_ - 1);
    if (period_s >= 1.0)
      lines_.Fail("as seconds, the stamps are " + YamlNumber(period_s) +
                  " s apart; name their unit in a header: 'timestamp [us]'");
  }

  const Columns columns_;
  TextLines lines_;
  Header comment_;
  std::optional<Layout> layout_;
  bool may_lack_unit_ = true;
  size_t count_ = 0;
  int64_t first_ns_ = 0, last_ns_ = 0;
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

void TextLines::Fail(const std::string& text) const {
  throw InputError("'" + name_ + "': " + Printable(text));
}

void TextLines::FailAt(size_t number, const std::string& text) const {
  Fail("line " + std::to_string(number) + " " + text);
}

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
