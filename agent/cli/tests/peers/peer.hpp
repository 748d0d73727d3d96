// Shared by the Fast DDS and the Cyclone DDS test peer: the command line, the event log, the pacing
// and the content of ros_discovery_info. The interface equals that of the roles `pub` and `sub` of
// agent/cli/examples/robot. Independent of the middleware.
#pragma once

#include <getopt.h>
#include <poll.h>
#include <signal.h>
#include <time.h>
#include <unistd.h>

#include <array>
#include <cinttypes>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <mutex>
#include <string>
#include <vector>

namespace peer {

constexpr const char* kPointCloudType = "sensor_msgs::msg::dds_::PointCloud2_";
constexpr const char* kDiscoveryTopic = "ros_discovery_info";
constexpr const char* kDiscoveryType = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
// Overhead of a serialized PointCloud2 with no fields and frame_id "lidar": 4 bytes of
// encapsulation, 48 bytes before `data` and 1 after it.
constexpr size_t kPointCloudOverhead = 53;

using Guid = std::array<uint8_t, 16>;

// Returns the byte at an offset of a point cloud's data. Adjacent bytes and fragments differ.
inline uint8_t pattern(size_t place) {
  return static_cast<uint8_t>(place * 7 + (place >> 8) * 13 + (place >> 16));
}

inline volatile sig_atomic_t stopped = 0;

inline int64_t unix_ns() {
  timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  return now.tv_sec * 1000000000LL + now.tv_nsec;
}

inline void sleep_until_or_stop(int64_t due_ns) {
  while (!stopped) {
    int64_t left = due_ns - unix_ns();
    if (left <= 0) return;
    if (left > 50000000) left = 50000000;
    timespec pause{0, static_cast<long>(left)};
    nanosleep(&pause, nullptr);
  }
}

[[noreturn]] inline void fail(const char* what) {
  fprintf(stderr, "%s\n", what);
  exit(1);
}

struct Options {
  bool publishes = false;
  std::string topic = "/points";
  size_t size = 644000;
  double rate = 20.0;
  uint64_t count = 0;
  bool best_effort = false;
  bool transient_local = false;
  int depth = 10;
  int domain = 0;
  size_t gid_size = 24;
  std::vector<std::string> nodes;
  std::string log;
  int peers = 1;
  bool hold = false;
  // Number of samples after which a publisher waits again, repeatedly; 0 means never.
  uint64_t stretch = 0;
  double linger = 1.0;
  // Receive buffer per socket, limited by net.core.rmem_max: for bursts of point cloud fragments.
  uint32_t receive_buffer = 4 << 20;
  // Fast DDS: use its default transports, and share histories.
  bool default_transport = false;
  bool data_sharing = false;
  // Fast DDS: a thread sends the samples, and a write does not wait for it.
  bool asynchronous = false;
  // Fast DDS: only TCP, with a listening address or an address to connect to (IPV4:PORT).
  std::string tcp_listen, tcp_peer;
  // Fast DDS: a second topic for the messages, as rmw_fastrtps of Lyrical has.
  bool buffers = false;

  static Options parse(int argc, char** argv) {
    enum { kRole = 1, kTopic, kSize, kRate, kCount, kReliable, kBestEffort, kTransientLocal, kDepth,
           kDomain, kGidSize, kNode, kLog, kPeers, kHold, kStretch, kLinger,
           kReceiveBuffer, kTransport, kDataSharing, kTcpListen, kTcpPeer, kBuffers,
           kAsynchronous,
           kHelp };
    static const option names[] = {
        {"role", 1, nullptr, kRole},           {"topic", 1, nullptr, kTopic},
        {"size", 1, nullptr, kSize},           {"rate", 1, nullptr, kRate},
        {"count", 1, nullptr, kCount},         {"reliable", 0, nullptr, kReliable},
        {"best-effort", 0, nullptr, kBestEffort},
        {"transient-local", 0, nullptr, kTransientLocal},
        {"depth", 1, nullptr, kDepth},         {"domain", 1, nullptr, kDomain},
        {"gid-size", 1, nullptr, kGidSize},    {"node", 1, nullptr, kNode},
        {"log", 1, nullptr, kLog},             {"peers", 1, nullptr, kPeers},
        {"hold", 0, nullptr, kHold},           {"linger", 1, nullptr, kLinger},
        {"receive-buffer", 1, nullptr, kReceiveBuffer},
        {"stretch", 1, nullptr, kStretch},
        {"transport", 1, nullptr, kTransport}, {"data-sharing", 0, nullptr, kDataSharing},
        {"tcp-listen", 1, nullptr, kTcpListen}, {"tcp-peer", 1, nullptr, kTcpPeer},
        {"buffers", 1, nullptr, kBuffers},     {"asynchronous", 0, nullptr, kAsynchronous},
        {"help", 0, nullptr, kHelp},           {nullptr, 0, nullptr, 0}};
    Options options;
    bool role_given = false;
    for (int name; (name = getopt_long(argc, argv, "", names, nullptr)) != -1;) {
      switch (name) {
        case kRole:
          role_given = true;
          options.publishes = strcmp(optarg, "pub") == 0;
          if (!options.publishes && strcmp(optarg, "sub") != 0) fail("--role is pub or sub");
          break;
        case kBuffers:
          options.buffers = true;
          if (strcmp(optarg, "cpu") != 0) fail("--buffers is cpu");
          break;
        case kTopic: options.topic = optarg; break;
        case kSize: options.size = strtoull(optarg, nullptr, 10); break;
        case kRate: options.rate = strtod(optarg, nullptr); break;
        case kCount: options.count = strtoull(optarg, nullptr, 10); break;
        case kReliable: options.best_effort = false; break;
        case kBestEffort: options.best_effort = true; break;
        case kTransientLocal: options.transient_local = true; break;
        case kDepth: options.depth = atoi(optarg); break;
        case kDomain: options.domain = atoi(optarg); break;
        case kGidSize: options.gid_size = strtoull(optarg, nullptr, 10); break;
        case kNode: options.nodes.push_back(optarg); break;
        case kLog: options.log = optarg; break;
        case kPeers: options.peers = atoi(optarg); break;
        case kHold: options.hold = true; break;
        case kStretch: options.stretch = strtoull(optarg, nullptr, 10); break;
        case kLinger: options.linger = strtod(optarg, nullptr); break;
        case kReceiveBuffer:
          options.receive_buffer = static_cast<uint32_t>(strtoul(optarg, nullptr, 10));
          break;
        case kTransport:
          options.default_transport = strcmp(optarg, "default") == 0;
          if (!options.default_transport && strcmp(optarg, "udp") != 0)
            fail("--transport is default or udp");
          break;
        case kDataSharing: options.data_sharing = true; break;
        case kAsynchronous: options.asynchronous = true; break;
        case kTcpListen: options.tcp_listen = optarg; break;
        case kTcpPeer: options.tcp_peer = optarg; break;
        default:
          fail("usage: --role pub|sub [--topic /t] [--size BYTES] [--rate HZ] [--count N]\n"
               "  [--reliable|--best-effort] [--transient-local] [--depth N] [--domain D]\n"
               "  [--gid-size 24|16] [--node /ns/name]... [--log FILE] [--peers N] [--hold]\n"
               "  [--stretch SAMPLES] [--linger SECONDS] [--receive-buffer BYTES]\n"
               "  [--transport default|udp] [--data-sharing] [--tcp-listen IPV4:PORT | --tcp-peer IPV4:PORT]\n"
               "  [--buffers cpu] [--asynchronous]");
      }
    }
    if (!role_given) fail("--role pub|sub is missing");
    if (options.topic.empty() || options.topic[0] != '/') fail("--topic is not absolute");
    if (options.size < 64 || options.size % 4 != 0) fail("--size is not a multiple of 4 from 64");
    if (options.rate <= 0) fail("--rate is not positive");
    if (options.gid_size != 24 && options.gid_size != 16) fail("--gid-size is 24 or 16");
    if (options.nodes.empty()) options.nodes.push_back(options.publishes ? "/publisher" : "/subscriber");
    for (const auto& node : options.nodes)
      if (node.empty() || node[0] != '/') fail("--node is not absolute");
    return options;
  }

  size_t data_size() const { return size - kPointCloudOverhead; }

  // The first node owns the topic; each further one has its own silent endpoint.
  std::string topic_of(size_t node) const {
    return node == 0 ? topic : topic + "_" + std::to_string(node);
  }
};

inline std::string dds_topic(const std::string& ros_topic) { return "rt" + ros_topic; }

// One JSON object per line, flushed immediately, so that a killed process leaves a complete log.
class Log {
 public:
  Log(const Options& options, const char* stack) {
    if (options.log.empty()) return;
    file_ = fopen(options.log.c_str(), "w");
    if (!file_) fail(("cannot create " + options.log).c_str());
    fprintf(file_, "{\"ev\":\"start\",\"stack\":\"%s\",\"pid\":%d,\"t\":%" PRId64 "}\n", stack,
            getpid(), unix_ns());
    fflush(file_);
  }

  void endpoint(const char* kind, const Guid& guid, const std::string& topic,
                const std::string& node) {
    char text[33];
    for (size_t i = 0; i < guid.size(); i++) snprintf(text + 2 * i, 3, "%02x", guid[i]);
    line("{\"ev\":\"endpoint\",\"kind\":\"%s\",\"guid\":\"%s\",\"topic\":\"%s\",\"node\":\"%s\",\"t\":%" PRId64 "}\n",
         kind, text, topic.c_str(), node.c_str(), unix_ns());
  }

  void sent(bool accepted, uint64_t seq, size_t length, int64_t began) {
    line("{\"ev\":\"%s\",\"t\":%" PRId64 ",\"done\":%" PRId64 ",\"seq\":%" PRIu64 ",\"len\":%zu}\n",
         accepted ? "pub" : "pub_failed", began, unix_ns(), seq, length);
  }

  void received(uint64_t seq, size_t length, int64_t stamp) {
    line("{\"ev\":\"sub\",\"t\":%" PRId64 ",\"seq\":%" PRIu64 ",\"len\":%zu,\"stamp_ns\":%" PRId64 "}\n",
         unix_ns(), seq, length, stamp);
  }

  // Logs the writer's sequence number if the middleware exposes it.
  void received(uint64_t seq, int64_t sn, size_t length, int64_t stamp) {
    line("{\"ev\":\"sub\",\"t\":%" PRId64 ",\"seq\":%" PRIu64 ",\"sn\":%" PRId64 ",\"len\":%zu,\"stamp_ns\":%" PRId64 "}\n",
         unix_ns(), seq, sn, length, stamp);
  }

  void event(const char* name) { line("{\"ev\":\"%s\",\"t\":%" PRId64 "}\n", name, unix_ns()); }

 private:
  template <typename... Values>
  void line(const char* format, Values... values) {
    if (!file_) return;
    std::lock_guard<std::mutex> guard(lock_);
    fprintf(file_, format, values...);
    fflush(file_);
  }

  FILE* file_ = nullptr;
  std::mutex lock_;
};

// A node as ros_discovery_info describes it.
struct Node {
  std::string namespace_;
  std::string name;
  std::vector<Guid> readers;
  std::vector<Guid> writers;

  static Node of(const std::string& full_name) {
    size_t slash = full_name.rfind('/');
    return Node{slash == 0 ? "/" : full_name.substr(0, slash), full_name.substr(slash + 1), {}, {}};
  }
};

inline void stop_on_signals() {
  struct sigaction action = {};
  action.sa_handler = [](int) { stopped = 1; };
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGINT, &action, nullptr);
}

inline void say(const char* line) {
  puts(line);
  fflush(stdout);
}

// Waits for a line on standard input, or for a signal.
inline void wait_for_line() {
  pollfd input{0, POLLIN, 0};
  while (!stopped && poll(&input, 1, 50) <= 0) {
  }
  if (stopped) return;
  char byte;
  do {
    if (read(0, &byte, 1) != 1) fail("standard input ended before the start");
  } while (byte != '\n');
}

// Waits until `matched` reports enough peers, and then for the start.
inline void wait_for_start(const Options& options, const std::function<int()>& matched) {
  while (!stopped && matched() < options.peers) usleep(10000);
  say("matched");
  if (options.hold) {
    wait_for_line();
  } else {
    sleep_until_or_stop(unix_ns() + 500000000);
  }
}

// Calls `write(sequence, stamp)` at the requested rate, with absolute deadlines.
inline void send_all(const Options& options, Log& log,
                     const std::function<bool(uint64_t, int64_t)>& write) {
  int64_t start = unix_ns();
  uint64_t first = 0;
  for (uint64_t seq = 0; !stopped && (options.count == 0 || seq < options.count); seq++) {
    if (options.stretch > 0 && seq == first + options.stretch) {
      wait_for_line();
      start = unix_ns();
      first = seq;
    }
    sleep_until_or_stop(start + static_cast<int64_t>((seq - first) * 1e9 / options.rate));
    if (stopped) break;
    int64_t began = unix_ns();
    bool accepted = write(seq, began);
    log.sent(accepted, seq, options.size, began);
  }
  log.event("stop");
  say("done");
  sleep_until_or_stop(unix_ns() + static_cast<int64_t>(options.linger * 1e9));
}

}  // namespace peer
