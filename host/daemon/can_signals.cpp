#include "host/daemon/can_signals.hpp"

#include <fmt/format.h>
#include <net/if.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <span>
#include <vector>

namespace groma::daemon {
namespace {

using io::DbcMessage;
using io::DbcSignal;
using io::YamlValue;

// A unit as DBC files write it, in lower case and without blanks, and its size in SI units.
struct Unit {
  std::string_view name;
  double si;
};
constexpr std::array kSpeeds{
    Unit{"m/s", 1.0},       Unit{"mps", 1.0},        Unit{"m/sec", 1.0},       Unit{"mm/s", 1e-3},
    Unit{"cm/s", 1e-2},     Unit{"km/h", 1.0 / 3.6}, Unit{"km/hr", 1.0 / 3.6}, Unit{"kmh", 1.0 / 3.6},
    Unit{"kph", 1.0 / 3.6}, Unit{"m/min", 1.0 / 60}, Unit{"mph", 0.44704},     Unit{"ft/s", 0.3048},
};
constexpr double kDegree = std::numbers::pi / 180.0;
constexpr double kRpm = std::numbers::pi / 30.0;
constexpr std::array kRates{
    Unit{"rad/s", 1.0},         Unit{"rad/sec", 1.0},           Unit{"radps", 1.0},
    Unit{"mrad/s", 1e-3},       Unit{"deg/s", kDegree},         Unit{"deg/sec", kDegree},
    Unit{"degps", kDegree},     Unit{"dps", kDegree},           Unit{"degree/s", kDegree},
    Unit{"degrees/s", kDegree}, Unit{"mdeg/s", 1e-3 * kDegree}, Unit{"rpm", kRpm},
    Unit{"1/min", kRpm},        Unit{"rev/min", kRpm},          Unit{"u/min", kRpm},
    Unit{"min-1", kRpm},
};
// A scale further than this from the unit's own, either way, is a wrong conversion and not a calibration.
constexpr double kMaxScaleRatio = 2.0;
// One step of a speed or a rate that is larger (m/s, rad/s), and a largest value that is smaller, show a
// wrong factor. By hand.
constexpr double kLargestStep = 0.5;
constexpr double kSmallestMax = 0.1;

// What a quantity is measured in.
struct Dimension {
  std::string_view si;
  std::span<const Unit> units;
};

Dimension dimension_of(std::size_t quantity) {
  return quantity < 2 ? Dimension{"m/s", kSpeeds} : Dimension{"rad/s", kRates};
}

std::optional<double> size_of(std::span<const Unit> units, const std::string& name) {
  const auto found =
      std::find_if(units.begin(), units.end(), [&](const Unit& unit) { return unit.name == name; });
  return found == units.end() ? std::nullopt : std::optional(found->si);
}

// In lower case, without blanks; a degree sign (Latin-1 or UTF-8) becomes "deg".
std::string plain(std::string_view unit) {
  std::string out;
  for (const char c : unit) {
    if (c == ' ' || c == '\xC2') continue;
    if (c == '\xB0') {
      out += "deg";
    } else {
      out += c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
    }
  }
  return out;
}

std::string list_names(const auto& named) {
  constexpr std::size_t kMost = 8;
  std::string text;
  for (std::size_t i = 0; i < std::min(named.size(), kMost); ++i)
    text += (i == 0 ? "" : ", ") + named[i].name;
  return named.size() > kMost ? text + ", ..." : text;
}

template <typename Named>
const Named* find_named(const std::vector<Named>& all, std::string_view name) {
  const auto found = std::find_if(all.begin(), all.end(), [&](const Named& one) { return one.name == name; });
  return found == all.end() ? nullptr : &*found;
}

struct Found {
  const DbcMessage* message;
  const DbcSignal* signal;
};

// MESSAGE.SIGNAL
Found find_signal(const YamlValue& yaml, const std::vector<DbcMessage>& messages,
                  const std::filesystem::path& dbc) {
  const std::string name = yaml.text();
  const std::size_t dot = name.find('.');
  if (dot == std::string::npos)
    yaml.fail(fmt::format("is {}", io::shown(name)), "write it as MESSAGE.SIGNAL");
  const std::string message_name = name.substr(0, dot);
  const DbcMessage* message = find_named(messages, message_name);
  if (message == nullptr) {
    yaml.fail(fmt::format("names the message {}, which {} lacks", io::shown(message_name), dbc.string()),
              messages.empty() ? "name a DBC file with messages"
                               : fmt::format("name one of its messages: {}", list_names(messages)));
  }
  const DbcSignal* signal = find_named(message->signals, name.substr(dot + 1));
  if (signal == nullptr) {
    yaml.fail(fmt::format("names the signal {}, which the message {} lacks", io::shown(name.substr(dot + 1)),
                          message_name),
              fmt::format("name one of its signals: {}", list_names(message->signals)));
  }
  return {message, signal};
}

std::optional<DbcSignal> multiplexor_of(const YamlValue& yaml, const Found& found) {
  if (!found.signal->multiplexed) return std::nullopt;
  const std::vector<DbcSignal>& all = found.message->signals;
  const auto is_one = [](const DbcSignal& signal) { return signal.is_multiplexor; };
  if (std::count_if(all.begin(), all.end(), is_one) != 1) {
    yaml.fail("depends on no or on several multiplexors", "choose a signal with exactly one");
  }
  const DbcSignal& multiplexor = *std::find_if(all.begin(), all.end(), is_one);
  io::expect_readable(*found.message, multiplexor);
  return multiplexor;
}

// SI units in one unit of the signal.
double scale_of(const YamlValue& yaml, std::size_t quantity, const CanSignal& of,
                const std::optional<YamlValue>& given) {
  const Dimension dimension = dimension_of(quantity);
  const std::string& unit = of.signal.unit;
  const std::optional<double> si = size_of(dimension.units, plain(unit));
  const std::string place = io::to_string(of.signal.place);
  if (given) {
    const double scale = given->number();
    const double ratio = std::abs(scale) / si.value_or(std::abs(scale));
    if (scale == 0.0 || !(ratio <= kMaxScaleRatio && ratio >= 1.0 / kMaxScaleRatio)) {
      given->fail(
          fmt::format("is {}, and the unit in {} is {}", scale, place, io::shown(unit)),
          si ? fmt::format("write {}, or correct the unit in the DBC file", *si) : "write another number");
    }
    return scale;
  }
  if (si == 1.0) return 1.0;
  std::string scale = si ? fmt::format("{}", *si) : "X";
  std::string meaning = si ? "" : fmt::format(", X being the {} in one {}", dimension.si, io::shown(unit));
  if (quantity < 2 && size_of(kRates, plain(unit)))
    meaning = fmt::format(", X being {} times the wheel's radius in metres", *size_of(kRates, plain(unit)));
  if (unit.empty()) {
    scale = "1";
    meaning = fmt::format(" if it is in {}", dimension.si);
  }
  yaml.fail(fmt::format("is in {} by {}, not in {}", unit.empty() ? "no unit" : io::shown(unit), place,
                        dimension.si),
            fmt::format("write {{signal: {}, scale: {}}}{}", of.name, scale, meaning));
}

// A factor of another unit, or none at all, shows in the values that the signal can have.
void check_values(const YamlValue& yaml, std::size_t quantity, const CanSignal& of) {
  const DbcSignal& signal = of.signal;
  const bool is_integer =
      signal.type == DbcSignal::Type::kUnsigned || signal.type == DbcSignal::Type::kSigned;
  const double step = std::abs(signal.factor * of.scale);
  const std::string_view si = dimension_of(quantity).si;
  if (is_integer && step > kLargestStep) {
    yaml.fail(fmt::format("has steps of {} {} by its factor in {}", step, si, io::to_string(signal.place)),
              "correct the factor or the scale");
  }
  double most = std::numeric_limits<double>::infinity();
  if (signal.has_bounds()) {
    most = std::max(std::abs(signal.min), std::abs(signal.max)) * std::abs(of.scale);
  } else if (is_integer) {
    most = std::ldexp(step, static_cast<int>(signal.bits)) + std::abs(signal.offset * of.scale);
  }
  if (most < kSmallestMax) {
    yaml.fail(
        fmt::format("is at most {} {} by its factor and bounds in {}", most, si, io::to_string(signal.place)),
        "correct the factor, the bounds or the scale");
  }
}

CanSignal parse_signal(const YamlValue& yaml, std::size_t quantity, const std::vector<DbcMessage>& messages,
                       const std::filesystem::path& dbc) {
  const bool is_map = yaml.is_map();
  const YamlValue name = is_map ? yaml.at("signal") : yaml;
  const Found found = find_signal(name, messages, dbc);
  io::expect_readable(*found.message, *found.signal);
  CanSignal out;
  out.name = name.text();
  out.id = found.message->id;
  out.signal = *found.signal;
  out.multiplexor = multiplexor_of(name, found);
  out.scale = scale_of(name, quantity, out, is_map ? yaml.find("scale") : std::nullopt);
  check_values(name, quantity, out);
  return out;
}

}  // namespace

CanSignals parse_can_signals(const YamlValue& yaml, const std::filesystem::path& folder,
                             io::InputFiles& files) {
  yaml.expect_keys({{"can", "dbc", "signals"}, {"listen"}});
  CanSignals out;
  out.interface = yaml.at("can").text();
  if (out.interface.empty() || out.interface.size() >= IFNAMSIZ ||
      out.interface.find('/') != std::string::npos) {
    yaml.at("can").fail("is not the name of a network interface", "name it, such as can0");
  }
  const std::filesystem::path dbc = folder / yaml.at("dbc").text();
  const std::vector<DbcMessage> messages = io::parse_dbc(dbc, files.read(dbc));
  const YamlValue signals = yaml.at("signals");
  for (std::size_t i = 0; i < kCanQuantities; ++i) {
    if (const auto signal = signals.find(kCanQuantityNames.at(i)))
      out.used.at(i) = parse_signal(*signal, i, messages, dbc);
  }
  return out;
}

}  // namespace groma::daemon
