// The content of /metrics.
#include <array>
#include <cstddef>
#include <initializer_list>
#include <string>
#include <string_view>

#include "host/daemon/daemon.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

// Many requests do not keep the loop from its work.
constexpr double kMetricsPeriod_s = 0.1;

using Text = MetricsText;

constexpr std::array<std::string_view, 9> kStates{"UNINITIALIZED",
                                                  "CONVERGING",
                                                  "TRACKING",
                                                  "DEGRADED",
                                                  "LOST",
                                                  "CALIBRATION_DRIVE",
                                                  "CALIBRATING",
                                                  "WAITING_FOR_ODOMETRY",
                                                  "ODOMETRY_TIMES_WRONG"};

// In the order of filter::RangeOutcome.
constexpr std::array<std::string_view, 9> kRangeOutcomes{"used",           "gated",      "unknown_tag",
                                                         "unknown_anchor", "bad_value",  "out_of_order",
                                                         "not_started",    "not_active", "not_modelled"};

// A value of a label, and its sample.
struct Count {
  std::string_view of;
  std::uint64_t count = 0;
};

void add_each(Text& text, std::string_view name, std::string_view help, std::string_view label,
              std::initializer_list<Count> counts) {
  text.family(name, "counter", help);
  for (const Count& each : counts) text.add(each.count, Text::label(label, each.of));
}

void add_one(Text& text, std::string_view name, std::string_view help, std::uint64_t value) {
  text.family(name, "counter", help);
  text.add(value);
}

void add_session(Text& text, const Session& session, std::uint64_t implausible) {
  const SessionCounters& counters = session.counters();
  add_each(text, "groma_measurements_total", "Measurements passed on in the order of their times.", "kind",
           {{"odometry", counters.odometry},
            {"pose_prior", counters.pose_priors},
            {"range", counters.ranges},
            {"sensor", counters.sensors}});
  add_each(text, "groma_measurements_dropped_total", "Measurements that were dropped, by the reason.",
           "reason",
           {{"late", counters.dropped_late},
            {"odometry_out_of_order", counters.odometry_out_of_order},
            {"sensor_out_of_order", counters.sensors_out_of_order},
            {"robot_time_wrong", counters.robot_time_wrong},
            {"robot_time_early", counters.robot_time_early},
            {"steering_unknown", counters.steering_unknown},
            {"without_odometry", counters.without_odometry},
            {"implausible", implausible}});
  add_one(text, "groma_measurements_passed_late_total", "Measurements passed on out of order.",
          counters.passed_late);
  add_one(text, "groma_odometry_merged_total", "Odometry samples saved by merging.",
          counters.odometry_merged);
  add_one(text, "groma_robot_clock_set_total", "Steps of the robot's clock, and its restarts.",
          counters.robot_clock_set);
  add_one(text, "groma_waiting_overflows_total", "Measurements passed on before their wait was over.",
          counters.waiting_overflows);
  const RobotInputCounters robot = session.robot_counters();
  add_each(text, "groma_robot_lines_total", "Valid lines of the robot.", "class",
           {{"ODOMETRY", robot.odometry}, {"POSE_PRIOR", robot.pose_priors}, {"sensor", robot.sensors}});
  add_each(text, "groma_robot_lines_dropped_total", "Lines of the robot that were dropped, by the reason.",
           "reason",
           {{"torn", robot.torn}, {"unknown_class", robot.unknown_class}, {"bad_value", robot.bad_value}});
}

// Families with samples of each node; its link is a label.
class NodeText {
 public:
  using Node = link::ReportDecoder;

  NodeText(Text& text, const Session& session) : text_(text), session_(session) {}

  template <typename Action>
  void for_each(Action action) const {
    for (std::size_t i = 0; i < session_.node_count(); ++i) {
      action(session_.node(i).decoder(), Text::label("link", session_.node(i).name()));
    }
  }
  template <typename Value>
  void add(std::string_view name, std::string_view help, Value value) {
    text_.family(name, "counter", help);
    for_each([&](const Node& node, const std::string& link) { text_.add(std::uint64_t{value(node)}, link); });
  }
  template <typename Reasons>
  void add_by_reason(std::string_view name, std::string_view help, Reasons reasons) {
    text_.family(name, "counter", help);
    for_each([&](const Node& node, const std::string& link) {
      for (const Count& each : reasons(node)) {
        text_.add(each.count, link + "," + Text::label("reason", each.of));
      }
    });
  }

 private:
  Text& text_;
  const Session& session_;
};

using Node = NodeText::Node;

void add_nodes(Text& text, const Session& session) {
  NodeText nodes(text, session);
  nodes.add("groma_node_messages_total", "Valid messages of a node.",
            [](const Node& of) { return of.counters().messages; });
  nodes.add("groma_node_messages_malformed_total", "Intact frames of a node without a valid message.",
            [](const Node& of) { return of.counters().messages_malformed; });
  nodes.add("groma_node_reports_total", "Reports of ranges.",
            [](const Node& of) { return of.counters().reports; });
  nodes.add("groma_node_reports_repeated_total", "Reports that had been received before, and were dropped.",
            [](const Node& of) { return of.counters().reports_repeated; });
  nodes.add("groma_node_reports_lost_total", "Reports lost in a node's queue or on its link.",
            [](const Node& of) { return of.counters().frames_lost; });
  nodes.add("groma_node_ranges_total", "Valid ranges of a node.",
            [](const Node& of) { return of.counters().ranges; });
  nodes.add_by_reason("groma_node_ranges_dropped_total", "Ranges of a node that were dropped, by the reason.",
                      [](const Node& of) {
                        return std::array<Count, 3>{{{"not_ok", of.counters().ranges_not_ok},
                                                     {"out_of_bounds", of.counters().ranges_out_of_bounds},
                                                     {"bad_instant", of.counters().ranges_bad_instant}}};
                      });
  nodes.add("groma_node_time_replies_total", "Answers of a node to requests for its time.",
            [](const Node& of) { return of.counters().time_replies; });
  nodes.add("groma_node_time_replies_unmatched_total", "Answers of a node that are late, or to no request.",
            [](const Node& of) { return of.counters().time_replies_unmatched; });
}

void add_node_links(Text& text, const Session& session) {
  NodeText nodes(text, session);
  nodes.add("groma_node_frames_total", "Intact frames of a node.",
            [](const Node& of) { return of.frame_counters().frames; });
  nodes.add("groma_node_bytes_discarded_total", "Bytes of a node that belong to no frame.",
            [](const Node& of) { return of.frame_counters().bytes_discarded; });
  nodes.add_by_reason("groma_node_frames_dropped_total", "Frames of a node that were dropped, by the reason.",
                      [](const Node& of) {
                        const wire::FrameCounters& frames = of.frame_counters();
                        return std::array<Count, 5>{{{"crc", frames.crc_errors},
                                                     {"version", frames.version_errors},
                                                     {"oversize", frames.oversize},
                                                     {"cobs", frames.cobs_errors},
                                                     {"truncated", frames.truncated}}};
                      });
  nodes.add_by_reason(
      "groma_node_clock_restarts_total", "Restarts of the estimate of a node's clock, by the reason.",
      [](const Node& of) {
        return std::array<Count, 2>{{{"counter_fell_back", of.time().counters().counter_restarts},
                                     {"arrivals_jumped", of.time().counters().host_jumps}}};
      });
  text.family("groma_node_round_trip_seconds", "gauge", "Least delay of a node's link, both ways together.");
  nodes.for_each([&](const Node& node, const std::string& link) {
    if (const auto round_trip_s = node.time().round_trip_s()) text.add(*round_trip_s, link);
  });
}

std::array<Count, 7> can_events(const link::CanCounters& can) {
  return {{{"can_frames", can.frames},
           {"can_frames_overrun", can.frames_overrun},
           {"can_error_frames", can.error_frames},
           {"can_controller_overruns", can.controller_overruns},
           {"can_error_passive", can.error_passive},
           {"can_bus_off", can.bus_off},
           {"can_restarts", can.restarts}}};
}

void add_filter(Text& text, const filter::Counters& counters) {
  text.family("groma_filter_ranges_total", "counter", "Ranges that the filter took, by the outcome.");
  for (std::size_t i = 0; i < kRangeOutcomes.size(); ++i) {
    text.add(std::uint64_t{counters.ranges[static_cast<filter::RangeOutcome>(i)]},
             Text::label("outcome", kRangeOutcomes.at(i)));
  }
  add_one(text, "groma_filter_divergences_total", "Suspected divergences.", counters.divergences);
  add_one(text, "groma_filter_slips_total", "Wheel slips that ranges showed.", counters.slips);
}

}  // namespace

std::string_view Daemon::metrics() {
  const double now_s = loop_.now_s();
  if (now_s < metrics_until_s_) return metrics_;
  metrics_until_s_ = now_s + kMetricsPeriod_s;
  MetricsText text;
  text.family("groma_build_info", "gauge", "1; the version is a label.");
  text.add(std::uint64_t{1}, Text::label("version", io::program_version()));
  const std::string_view state = calibrator_->solving() ? "CALIBRATING" : pipeline_.state(now_s);
  text.family("groma_state", "gauge", "1 for the present state, 0 for the others.");
  for (const std::string_view of : kStates) text.add(std::uint64_t{of == state}, Text::label("state", of));
  text.histogram("groma_pose_latency_seconds",
                 "From the arrival of an odometry sample's last byte until the outputs have its pose.",
                 pose_latency_);
  const Localizer* const localizer = pipeline_.localizer();
  add_session(text, pipeline_.session(), localizer != nullptr ? localizer->implausible() : 0);
  if (localizer != nullptr) add_filter(text, localizer->filter().counters());
  add_nodes(text, pipeline_.session());
  add_node_links(text, pipeline_.session());
  add_links(text);
  add_outputs(text);
  add_one(text, "groma_calibrations_adopted_total", "Calibrations that localization has taken over.",
          pipeline_.calibrations_adopted());
  if (calibrator_->learner() != nullptr) {
    add_one(text, "groma_calibration_steps_total", "Solutions of the calibration while driving.",
            calibrator_->learner()->steps());
  }
  metrics_ = text.text();
  return metrics_;
}

void Daemon::add_links(MetricsText& text) const {
  const auto each = [&](std::string_view name, std::string_view type, std::string_view help, auto value) {
    text.family(name, type, help);
    for (const auto& input : inputs_) {
      text.add(std::uint64_t{value(*input)}, Text::label("link", input->name()));
    }
  };
  each("groma_link_open", "gauge", "1 while a link is open.",
       [](const LinkInput& input) { return input.link() != nullptr; });
  each("groma_link_opened_total", "counter", "How often a link was opened.",
       [](const LinkInput& input) { return input.counters().opened; });
  each("groma_link_lost_total", "counter", "How often a link was lost.",
       [](const LinkInput& input) { return input.counters().lost; });
  each("groma_link_attempts_failed_total", "counter", "Attempts to open a link that failed.",
       [](const LinkInput& input) { return input.counters().attempts_failed; });
  text.family("groma_link_events_total", "counter", "Events on a CAN bus that a link counts.");
  for (const auto& input : inputs_) {
    const auto can = input->can_counters();
    if (!can) continue;
    for (const Count& event : can_events(*can)) {
      text.add(event.count, Text::label("link", input->name()) + "," + Text::label("event", event.of));
    }
  }
}

void Daemon::add_outputs(MetricsText& text) const {
  const PoseServerCounters& stream = pose_server_->counters();
  text.family("groma_stream_clients", "gauge", "Clients of the pose stream.");
  text.add(std::uint64_t{pose_server_->client_count()});
  text.family("groma_stream_waiting_bytes", "gauge", "Bytes that wait for clients of the pose stream.");
  text.add(std::uint64_t{pose_server_->waiting_bytes()});
  add_each(text, "groma_stream_clients_total", "Clients of the pose stream, by what became of them.", "event",
           {{"accepted", stream.accepted},
            {"refused", stream.refused},
            {"disconnected", stream.disconnected},
            {"too_slow", stream.too_slow}});
  if (ros2_ != nullptr) {
    const Ros2Counters ros2 = ros2_->counters();
    add_each(text, "groma_ros2_messages_total", "Messages of ROS 2, by what became of them.", "event",
             {{"taken", ros2.lines}, {"refused", ros2.refused}, {"left_out", ros2.left_out}});
  }
  const web::Counters& web = web_server_->counters();
  add_each(text, "groma_web_clients_total", "Clients of the web server, by what became of them.", "event",
           {{"accepted", web.accepted}, {"refused", web.refused}, {"timed_out", web.timed_out}});
  add_one(text, "groma_web_requests_total", "Answers of the web server.", web.requests);
  add_one(text, "groma_web_requests_forbidden_total", "Of those: wrong host, origin or token.",
          web.forbidden);
  add_one(text, "groma_web_sockets_total", "WebSockets opened.", web.sockets);
  add_each(text, "groma_web_messages_total", "Messages of WebSockets, by what became of them.", "event",
           {{"sent", web.messages}, {"left_out", web.left_out}, {"ignored", web.ignored}});
}

}  // namespace groma::daemon
