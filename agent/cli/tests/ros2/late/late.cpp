// A node whose callback is late for the cause that the message names, and its publisher.
//
//   late subscribe FILE   node /late: subscriptions of /work and /before in one executor
//   late publish NUMBER   waits for NUMBER subscriptions of /work. Then each line of standard input
//                         `COUNT PERIOD_MS COMMAND [BYTES [BURST]]` publishes BURST messages of
//                         BYTES in each period
//
//   late measure          node /measured: a callback that computes for 50 us
//   late switch RATE      two processes that wake each other, with RATE switches a second in all
//
// After the message `report` the subscriber prints `COUNT NANOSECONDS`: the calls since the last
// report, and the time of their injected causes. The measured node prints `COUNT NANOSECONDS
// NANOSECONDS`: the 99th percentiles of the duration of its calls, and of their delay since the
// publication.

#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <condition_variable>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "rclcpp/rclcpp.hpp"
#include "std_msgs/msg/string.hpp"

using std_msgs::msg::String;

namespace
{
constexpr int64_t kMillisecond = 1'000'000;

int64_t read_clock(clockid_t clock)
{
  timespec time{};
  clock_gettime(clock, &time);
  return time.tv_sec * 1'000'000'000LL + time.tv_nsec;
}

// Uses the CPU for this time.
int64_t compute(int64_t nanoseconds)
{
  const int64_t begin = read_clock(CLOCK_THREAD_CPUTIME_ID);
  volatile uint64_t work = 0;
  while (read_clock(CLOCK_THREAD_CPUTIME_ID) - begin < nanoseconds) {
    for (int i = 0; i < 1000; ++i) {
      work = work + i;
    }
  }
  return nanoseconds;
}

void sleep_for(int64_t nanoseconds)
{
  const timespec time{nanoseconds / 1'000'000'000, nanoseconds % 1'000'000'000};
  nanosleep(&time, nullptr);
}

void sleep_until(int64_t nanoseconds)
{
  const timespec time{nanoseconds / 1'000'000'000, nanoseconds % 1'000'000'000};
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, nullptr);
}

// A process that stops this one for 30 ms on request.
class Stopper
{
public:
  Stopper()
  {
    int ends[2];
    if (pipe(ends) != 0) {
      std::abort();
    }
    const pid_t parent = getpid();
    if (fork() == 0) {
      prctl(PR_SET_PDEATHSIG, SIGKILL);
      prctl(PR_SET_NAME, "stopper");
      close(ends[1]);
      char byte;
      while (read(ends[0], &byte, 1) == 1) {
        kill(parent, SIGSTOP);
        sleep_for(30 * kMillisecond);
        kill(parent, SIGCONT);
      }
      _exit(0);
    }
    close(ends[0]);
    request_ = ends[1];
  }

  // Returns for how long this thread did not run.
  int64_t stop()
  {
    const int64_t begin = read_clock(CLOCK_MONOTONIC);
    if (write(request_, "", 1) != 1) {
      std::abort();
    }
    int64_t last = begin, gap = 0;
    while (gap < 20 * kMillisecond && last - begin < 500 * kMillisecond) {
      const int64_t next = read_clock(CLOCK_MONOTONIC);
      gap = std::max(gap, next - last);
      last = next;
    }
    return gap;
  }

private:
  int request_;
};

// A thread that holds a lock for 30 ms on request.
class Holder
{
public:
  Holder() : thread_(&Holder::run, this) {pthread_setname_np(thread_.native_handle(), "holder");}

  // Returns how long the lock took.
  int64_t wait()
  {
    std::unique_lock<std::mutex> turn(turn_);
    is_wanted_ = true;
    changed_.notify_all();
    changed_.wait(turn, [this] {return !is_wanted_;});
    turn.unlock();
    const int64_t begin = read_clock(CLOCK_MONOTONIC);
    std::lock_guard<std::mutex> held(held_);
    return read_clock(CLOCK_MONOTONIC) - begin;
  }

private:
  void run()
  {
    for (;;) {
      std::unique_lock<std::mutex> turn(turn_);
      changed_.wait(turn, [this] {return is_wanted_;});
      std::lock_guard<std::mutex> held(held_);
      is_wanted_ = false;
      changed_.notify_all();
      turn.unlock();
      sleep_for(30 * kMillisecond);
    }
  }

  std::mutex turn_, held_;
  std::condition_variable changed_;
  bool is_wanted_ = false;
  std::thread thread_;
};

// A mapped file whose pages are read from the disk.
class Pages
{
public:
  explicit Pages(const std::string & path)
  : file_(open(path.c_str(), O_RDWR | O_CREAT | O_TRUNC, 0600))
  {
    const std::string block(1 << 20, 'x');
    for (size_t written = 0; written < kSize; written += block.size()) {
      if (write(file_, block.data(), block.size()) < 0) {
        std::abort();
      }
    }
    fsync(file_);
    void * pages = mmap(nullptr, kSize, PROT_READ, MAP_SHARED, file_, 0);
    if (pages == MAP_FAILED) {
      std::abort();
    }
    pages_ = static_cast<const char *>(pages);
    madvise(pages, kSize, MADV_RANDOM);
  }

  // Reads pages from the disk for 30 ms. Returns how long that took.
  int64_t read()
  {
    madvise(const_cast<char *>(pages_), kSize, MADV_DONTNEED);
    posix_fadvise(file_, 0, kSize, POSIX_FADV_DONTNEED);
    const int64_t begin = read_clock(CLOCK_MONOTONIC);
    int64_t taken = 0;
    volatile char sum = 0;
    for (size_t at = 0; at < kSize && taken < 30 * kMillisecond; at += 16 << 12) {
      sum = sum + pages_[at];
      taken = read_clock(CLOCK_MONOTONIC) - begin;
    }
    return taken;
  }

private:
  static constexpr size_t kSize = 64 << 20;
  int file_;
  const char * pages_;
};

class Late : public rclcpp::Node
{
public:
  Late(const std::string & file, Stopper & stopper)
  : Node("late"), file_(open(file.c_str(), O_RDWR | O_CREAT | O_TRUNC, 0600)), stopper_(stopper),
    pages_(file + ".pages")
  {
    bytes_.resize(64 << 10, 'x');
    work_ = create_subscription<String>(
      "/work", 100, [this](String::ConstSharedPtr message, const rclcpp::MessageInfo & info) {
        std::string command;
        std::istringstream(message->data) >> command;
        handle(command, info.get_rmw_message_info().source_timestamp);
      });
    before_ = create_subscription<String>(
      "/before", 100, [](String::ConstSharedPtr) {compute(30 * kMillisecond);});
  }

private:
  void handle(const std::string & command, int64_t published)
  {
    if (command == "report") {
      std::cout << calls_ << ' ' << injected_ << " reported" << std::endl;
      calls_ = injected_ = 0;
      return;
    }
    calls_ += 1;
    const int64_t begin = read_clock(CLOCK_MONOTONIC);
    if (command == "sleep") {
      sleep_for(30 * kMillisecond);
    } else if (command == "compute") {
      compute(20 * kMillisecond);
    } else if (command == "brief") {
      compute(5 * kMillisecond);
    } else if (command == "pages") {
      injected_ += pages_.read();
      return;
    } else if (command == "delay") {
      injected_ += read_clock(CLOCK_REALTIME) - published;
      return;
    } else if (command == "lock") {
      injected_ += holder_.wait();
      return;
    } else if (command == "stop") {
      injected_ += stopper_.stop();
      return;
    } else if (command == "disk") {
      for (int64_t synced = 0; synced < 30 * kMillisecond; ) {
        if (pwrite(file_, bytes_.data(), bytes_.size(), 0) < 0) {
          std::abort();
        }
        const int64_t sync = read_clock(CLOCK_MONOTONIC);
        fsync(file_);
        const int64_t taken = read_clock(CLOCK_MONOTONIC) - sync;
        synced += taken;
        injected_ += taken;
      }
      return;
    }
    injected_ += read_clock(CLOCK_MONOTONIC) - begin;
  }

  int file_;
  Stopper & stopper_;
  Pages pages_;
  Holder holder_;
  std::string bytes_;
  int64_t calls_ = 0, injected_ = 0;
  rclcpp::Subscription<String>::SharedPtr work_, before_;
};

// Measures its own calls.
class Measured : public rclcpp::Node
{
public:
  Measured() : Node("measured")
  {
    work_ = create_subscription<String>(
      "/work", 1000, [this](String::ConstSharedPtr message, const rclcpp::MessageInfo & info) {
        if (message->data == "report ") {
          const auto count = durations_.size();
          std::cout << count << ' ' << percentile(durations_) << ' ' << percentile(delays_) <<
            " reported" << std::endl;
          return;
        }
        const int64_t begin = read_clock(CLOCK_MONOTONIC);
        delays_.push_back(
          read_clock(CLOCK_REALTIME) - info.get_rmw_message_info().source_timestamp);
        compute(50'000);
        durations_.push_back(read_clock(CLOCK_MONOTONIC) - begin);
      });
  }

private:
  static int64_t percentile(std::vector<int64_t> & values)
  {
    std::sort(values.begin(), values.end());
    const int64_t value = values.empty() ? 0 : values[values.size() * 99 / 100];
    values.clear();
    return value;
  }

  std::vector<int64_t> durations_, delays_;
  rclcpp::Subscription<String>::SharedPtr work_;
};

// Two processes that pass a byte to each other. A round has two switches at least.
void wake_each_other(int64_t switches_per_second)
{
  int there[2], back[2];
  if (pipe(there) != 0 || pipe(back) != 0) {
    std::abort();
  }
  char byte = 0;
  if (fork() == 0) {
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    while (read(there[0], &byte, 1) == 1 && write(back[1], &byte, 1) == 1) {
    }
    _exit(0);
  }
  int64_t due = read_clock(CLOCK_MONOTONIC);
  for (;;) {
    due += kMillisecond;
    sleep_until(due);
    for (int64_t i = 0; i < switches_per_second / 2000; ++i) {
      if (write(there[1], &byte, 1) != 1 || read(back[0], &byte, 1) != 1) {
        return;
      }
    }
  }
}

void publish(size_t subscriptions)
{
  auto node = std::make_shared<rclcpp::Node>("worker");
  auto work = node->create_publisher<String>("/work", 100);
  auto before = node->create_publisher<String>("/before", 100);
  while (work->get_subscription_count() < subscriptions) {
    sleep_for(20 * kMillisecond);
  }
  std::cout << "matched" << std::endl;
  std::string line;
  while (std::getline(std::cin, line)) {
    int count = 0, period = 0, burst = 1;
    size_t bytes = 0;
    std::string command;
    std::istringstream(line) >> count >> period >> command >> bytes >> burst;
    String message;
    message.data = command + ' ';
    message.data.resize(std::max(bytes, message.data.size()), 'x');
    int64_t due = read_clock(CLOCK_MONOTONIC);
    for (int i = 0; i < count; ++i) {
      if (command == "before") {
        before->publish(message);
      }
      for (int j = 0; j < burst; ++j) {
        work->publish(message);
      }
      due += period * kMillisecond;
      sleep_until(due);
    }
    std::cout << "sent" << std::endl;
  }
}
}  // namespace

int main(int argc, char ** argv)
{
  const std::string role = argc > 1 ? argv[1] : "";
  std::unique_ptr<Stopper> stopper;
  if (role == "subscribe" && argc > 2) {
    stopper = std::make_unique<Stopper>();
  }
  rclcpp::init(argc, argv);
  if (stopper) {
    auto node = std::make_shared<Late>(argv[2], *stopper);
    std::cout << "ready" << std::endl;
    rclcpp::spin(node);
  } else if (role == "publish" && argc > 2) {
    publish(std::stoul(argv[2]));
  } else if (role == "measure") {
    auto node = std::make_shared<Measured>();
    std::cout << "ready" << std::endl;
    rclcpp::spin(node);
  } else if (role == "switch" && argc > 2) {
    wake_each_other(std::stol(argv[2]));
  } else {
    std::cerr << "late subscribe FILE | publish NUMBER | measure | switch RATE" << std::endl;
    return 2;
  }
  rclcpp::shutdown();
  return 0;
}
