// Shared by the C++ peers of the interoperability matrix: the command line, the log and the course
// of a peer. Independent of the middleware.
#pragma once

#include <set>

#include "../peer.hpp"

namespace shapes {

constexpr const char* kType = "ShapeType";
constexpr int32_t kShapeSize = 30;
// Samples above this size do not fit into one UDP datagram.
constexpr size_t kDatagram = 65000;
// The time between the match and the first sample, unless a line on standard input starts it.
constexpr int64_t kSettleNs = 500000000;
constexpr int64_t kPollNs = 2000000;

[[noreturn]] inline void refuse(const std::string& reason) {
  fprintf(stderr, "%s\n", reason.c_str());
  exit(2);
}

struct Options {
  bool publishes = false;
  int domain = 0;
  std::string topic = "Square", color = "BLUE", filter, log;
  bool best_effort = false, transient_local = false, keep_all = false, exclusive = false;
  int depth = 100, strength = 0, peers = 1;
  // Milliseconds; negative means none.
  int64_t deadline = -1, lifespan = -1, lease = -1;
  std::vector<std::string> partitions;
  size_t size = 0;
  double rate = 20.0, linger = 1.0;
  // The number of samples to send, or to receive before the end; 0 means no limit.
  uint64_t count = 0;
  // A publisher waits for a line on standard input each time it has sent this many samples; 0 means
  // that it does not wait.
  uint64_t stretch = 0;
  bool hold = false;

  // `missing` are the capabilities that the library lacks.
  static Options parse(int argc, char** argv, const std::set<std::string>& missing) {
    enum { kRole = 1, kDomain, kTopic, kColor, kReliable, kBestEffort, kDurability, kDepth,
           kKeepAll, kStrength, kExclusive, kDeadline, kLifespan, kLease, kPartition, kFilter, kSize, kRate,
           kCount, kPeers, kHold, kStretch, kLinger, kLog, kCapabilities };
    static const option names[] = {
        {"role", 1, nullptr, kRole},
        {"domain", 1, nullptr, kDomain},
        {"topic", 1, nullptr, kTopic},
        {"color", 1, nullptr, kColor},
        {"reliable", 0, nullptr, kReliable},
        {"best-effort", 0, nullptr, kBestEffort},
        {"durability", 1, nullptr, kDurability},
        {"depth", 1, nullptr, kDepth},
        {"keep-all", 0, nullptr, kKeepAll},
        {"ownership-strength", 1, nullptr, kStrength},
        {"exclusive", 0, nullptr, kExclusive},
        {"deadline", 1, nullptr, kDeadline},
        {"lifespan", 1, nullptr, kLifespan},
        {"liveliness-lease", 1, nullptr, kLease},
        {"partition", 1, nullptr, kPartition},
        {"filter", 1, nullptr, kFilter},
        {"size", 1, nullptr, kSize},
        {"rate", 1, nullptr, kRate},
        {"count", 1, nullptr, kCount},
        {"peers", 1, nullptr, kPeers},
        {"hold", 0, nullptr, kHold},
        {"stretch", 1, nullptr, kStretch},
        {"linger", 1, nullptr, kLinger},
        {"log", 1, nullptr, kLog},
        {"capabilities", 0, nullptr, kCapabilities},
        {nullptr, 0, nullptr, 0}};
    Options options;
    bool role_given = false, lists = false;
    auto need = [&](const char* capability) {
      if (missing.count(capability)) refuse(std::string(capability) + " is not supported");
    };
    for (int name; (name = getopt_long(argc, argv, "", names, nullptr)) != -1;) {
      const std::string text = optarg ? optarg : "";
      switch (name) {
        case kRole:
          role_given = true;
          options.publishes = text == "pub";
          if (!options.publishes && text != "sub") refuse("--role is pub or sub");
          break;
        case kDomain: options.domain = atoi(optarg); break;
        case kTopic: options.topic = text; break;
        case kColor: options.color = text; break;
        case kReliable: options.best_effort = false; break;
        case kBestEffort: options.best_effort = true; break;
        case kDurability:
          options.transient_local = text == "transient-local";
          if (!options.transient_local && text != "volatile")
            refuse("--durability is volatile or transient-local");
          break;
        case kDepth: options.depth = atoi(optarg); break;
        case kKeepAll: options.keep_all = true; break;
        case kStrength:
          options.exclusive = true;
          options.strength = atoi(optarg);
          break;
        case kExclusive: options.exclusive = true; break;
        case kDeadline: options.deadline = atoll(optarg); break;
        case kLifespan: options.lifespan = atoll(optarg); break;
        case kLease: options.lease = atoll(optarg); break;
        case kPartition: options.partitions.push_back(text); break;
        case kFilter:
          options.filter = text;
          need("filter");
          break;
        case kSize:
          options.size = strtoull(optarg, nullptr, 10);
          if (options.size > kDatagram) need("fragments");
          break;
        case kRate: options.rate = strtod(optarg, nullptr); break;
        case kCount: options.count = strtoull(optarg, nullptr, 10); break;
        case kPeers: options.peers = atoi(optarg); break;
        case kHold: options.hold = true; break;
        case kStretch: options.stretch = strtoull(optarg, nullptr, 10); break;
        case kLinger: options.linger = strtod(optarg, nullptr); break;
        case kLog: options.log = text; break;
        case kCapabilities: lists = true; break;
        default: exit(2);
      }
    }
    if (optind < argc) refuse(std::string(argv[optind]) + " is unknown");
    if (lists) list(missing);
    if (!role_given) refuse("--role is missing");
    return options;
  }

  // Returns the additional payload of each sample.
  std::vector<uint8_t> payload() const {
    std::vector<uint8_t> bytes(size);
    for (size_t place = 0; place < size; place++) bytes[place] = static_cast<uint8_t>(place);
    return bytes;
  }

 private:
  [[noreturn]] static void list(const std::set<std::string>& missing) {
    const char* separator = "{";
    for (const char* name : {"reliability", "durability", "late_joiner", "ownership", "arbitration",
                             "deadline", "lifespan", "liveliness", "partition", "filter",
                             "fragments", "incompatible_qos", "matched"}) {
      printf("%s\"%s\":%s", separator, name, missing.count(name) ? "false" : "true");
      separator = ",";
    }
    puts("}");
    exit(0);
  }
};

// One JSON object per line, flushed immediately, so that a killed process leaves a complete log.
class Log {
 public:
  explicit Log(const std::string& path) {
    if (path.empty()) return;
    file_ = fopen(path.c_str(), "w");
    if (!file_) peer::fail(("cannot create " + path).c_str());
  }

  void write(const char* event) { write(event, "%s", ""); }

  // Writes an event; each field has a comma before it.
  template <typename... Values>
  void write(const char* event, const char* format, Values... values) {
    if (!file_) return;
    fprintf(file_, "{\"t\":%" PRId64 ",\"ev\":\"%s\"", peer::unix_ns(), event);
    fprintf(file_, format, values...);
    fputs("}\n", file_);
    fflush(file_);
  }

 private:
  FILE* file_ = nullptr;
};

struct Sample {
  int32_t number;
  std::string color;
  size_t length;
};

// What happened since the last poll, and the number of matched endpoints now.
struct Events {
  int matched = 0;
  std::vector<uint32_t> incompatible;
  std::vector<Sample> samples;
};

// One participant with one endpoint.
class Peer {
 public:
  virtual ~Peer() = default;
  virtual peer::Guid guid() = 0;
  virtual void write(int32_t number) = 0;
  virtual Events poll() = 0;
};

// Returns the standard name of the policy with this standard number.
inline const char* policy_name(uint32_t number) {
  static const char* const names[] = {
      "INVALID", "USER_DATA", "DURABILITY", "PRESENTATION", "DEADLINE", "LATENCY_BUDGET",
      "OWNERSHIP", "OWNERSHIP_STRENGTH", "LIVELINESS", "TIME_BASED_FILTER", "PARTITION",
      "RELIABILITY", "DESTINATION_ORDER", "HISTORY", "RESOURCE_LIMITS", "ENTITY_FACTORY",
      "WRITER_DATA_LIFECYCLE", "READER_DATA_LIFECYCLE", "TOPIC_DATA", "GROUP_DATA",
      "TRANSPORT_PRIORITY", "LIFESPAN", "DURABILITY_SERVICE", "DATA_REPRESENTATION",
      "TYPE_CONSISTENCY_ENFORCEMENT"};
  return names[number < sizeof names / sizeof *names ? number : 0];
}

// The course of a peer: it waits for the other peers, and sends or receives.
class Course {
 public:
  Course(const Options& options, const char* stack, Peer& peer)
      : options_(options), peer_(peer), log_(options.log) {
    char guid[33] = "";
    size_t place = 0;
    for (uint8_t byte : peer.guid()) place += snprintf(guid + place, 3, "%02x", byte);
    log_.write("start", ",\"stack\":\"%s\",\"pid\":%d,\"guid\":\"%s\"", stack, getpid(), guid);
  }

  void run() {
    peer::say("ready");
    pump([&] { return matched_ < options_.peers && !is_complete(); });
    if (!peer::stopped) peer::say("matched");
    if (options_.publishes) {
      publish();
    } else {
      pump([&] { return !is_complete(); });
    }
    log_.write("stop");
  }

 private:
  void publish() {
    if (options_.hold) {
      wait_for_line();
    } else {
      pump_until(peer::unix_ns() + kSettleNs);
    }
    int64_t start = peer::unix_ns();
    uint64_t first = 0;
    for (uint64_t number = 0; options_.count == 0 || number < options_.count; number++) {
      if (options_.stretch > 0 && number == first + options_.stretch) {
        wait_for_line();
        start = peer::unix_ns();
        first = number;
      }
      pump_until(start + static_cast<int64_t>((number - first) * 1e9 / options_.rate));
      if (peer::stopped) break;
      peer_.write(static_cast<int32_t>(number));
      log_.write("pub", ",\"seq\":%" PRIu64 ",\"len\":%zu", number, options_.size);
    }
    peer::say("done");
    pump_until(peer::unix_ns() + static_cast<int64_t>(options_.linger * 1e9));
  }

  void wait_for_line() {
    pollfd input{0, POLLIN, 0};
    pump([&] { return ::poll(&input, 1, 0) <= 0; });
    peer::wait_for_line();
  }

  void pump_until(int64_t due) {
    pump([&] { return peer::unix_ns() < due; });
  }

  // Logs what happens while the condition holds, at least once.
  template <typename Condition>
  void pump(Condition condition) {
    for (;;) {
      note(peer_.poll());
      if (peer::stopped || !condition()) return;
      peer::sleep_until_or_stop(peer::unix_ns() + kPollNs);
    }
  }

  void note(const Events& events) {
    if (events.matched != matched_) {
      matched_ = events.matched;
      log_.write("matched", ",\"total\":%d", matched_);
    }
    for (uint32_t id : events.incompatible)
      log_.write("incompatible", ",\"policy\":\"%s\"", policy_name(id));
    for (const Sample& sample : events.samples) {
      log_.write("sub", ",\"seq\":%d,\"color\":\"%s\",\"len\":%zu", sample.number,
                 sample.color.c_str(), sample.length);
      received_++;
    }
  }

  bool is_complete() const { return options_.count != 0 && received_ >= options_.count; }

  const Options& options_;
  Peer& peer_;
  Log log_;
  int matched_ = 0;
  uint64_t received_ = 0;
};

}  // namespace shapes
