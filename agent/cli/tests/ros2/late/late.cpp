// A node whose callback is late for the cause that the message names, and its publisher.
//
//   late subscribe FILE   node /late: subscriptions of /work and /before in one executor
//   late publish          each line of standard input `COUNT PERIOD_MS COMMAND` publishes messages
//
// After the message `report` the subscriber prints `COUNT NANOSECONDS`: the calls since the last
// report, and the time of their injected causes.

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

class Late : public rclcpp::Node
{
public:
  Late(const std::string & file, Stopper & stopper)
  : Node("late"), file_(open(file.c_str(), O_RDWR | O_CREAT | O_TRUNC, 0600)), stopper_(stopper)
  {
    bytes_.resize(64 << 10, 'x');
    work_ = create_subscription<String>(
      "/work", 100, [this](String::ConstSharedPtr message) {handle(message->data);});
    before_ = create_subscription<String>(
      "/before", 100, [](String::ConstSharedPtr) {compute(30 * kMillisecond);});
  }

private:
  void handle(const std::string & command)
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
  Holder holder_;
  std::string bytes_;
  int64_t calls_ = 0, injected_ = 0;
  rclcpp::Subscription<String>::SharedPtr work_, before_;
};

void publish()
{
  auto node = std::make_shared<rclcpp::Node>("worker");
  auto work = node->create_publisher<String>("/work", 100);
  auto before = node->create_publisher<String>("/before", 100);
  while (work->get_subscription_count() < 1 || before->get_subscription_count() < 1) {
    sleep_for(20 * kMillisecond);
  }
  std::cout << "matched" << std::endl;
  std::string line;
  while (std::getline(std::cin, line)) {
    int count = 0, period = 0;
    String message;
    std::istringstream(line) >> count >> period >> message.data;
    for (int i = 0; i < count; ++i) {
      if (message.data == "before") {
        before->publish(message);
      }
      work->publish(message);
      sleep_for(period * kMillisecond);
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
  } else if (role == "publish") {
    publish();
  } else {
    std::cerr << "late subscribe FILE | late publish" << std::endl;
    return 2;
  }
  rclcpp::shutdown();
  return 0;
}
