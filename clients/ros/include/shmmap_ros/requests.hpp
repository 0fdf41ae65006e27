// SPDX-License-Identifier: Apache-2.0
//
// Requests of ROS 2 nodes that wait for cells or for the daemon, each in a thread of its own: so none waits for
// another, and an executor waits for none.  Includes nothing of ROS.

#ifndef SHMMAP_ROS_REQUESTS_HPP
#define SHMMAP_ROS_REQUESTS_HPP

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <deque>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <optional>
#include <shmmap/autoware.hpp>
#include <string>
#include <thread>
#include <utility>

namespace shmmap_ros {

/// Where lines for a log go.
struct Log {
  using Line = std::function<void(const std::string&)>;
  Line error, warn, info;
};

/// Answers requests in threads, with a connection to the daemon each.  A thread that had nothing to do for ten seconds
/// ends.
class Requests {
 public:
  /// Above `max_waiting` requests the oldest, whose client has given up, is answered with nothing.
  Requests(shmmap::LoaderOptions options, Log log, std::size_t max_waiting = 256)
      : options_(std::move(options)), log_(std::move(log)), max_waiting_(max_waiting) {}
  Requests(const Requests&) = delete;
  Requests& operator=(const Requests&) = delete;
  ~Requests() { stop(); }

  /// Have a request answered: `done(response)` is called once, in a thread; after `stop` perhaps not at all.
  template <typename Service>
  void ask(std::shared_ptr<const typename Service::Request> request,
           std::function<void(typename Service::Response&)> done) {
    const auto job = std::make_shared<Job>();
    job->run = [this, request = std::move(request), done = std::move(done), one = job.get()](
                   const shmmap::MapServices& services) {
      const auto response = answered<Service>(services, *request, *one);
      if (response) done(*response);
    };
    const std::lock_guard<std::mutex> lock(mutex_);
    if (stopped_) return;
    reap();
    jobs_.push_back(job);
    waiting_.push_back(job);
    if (waiting_.size() > max_waiting_) {
      waiting_.front()->is_given_up = true;
      waiting_.pop_front();
    }
    if (jobs_.size() > idle_) {
      const auto thread = threads_.emplace(threads_.end());
      *thread = std::thread([this, thread] { work(thread); });
    }
    news_.notify_one();
  }

  /// Record whether the daemon answers, and log that where it changes.
  void record(bool is_there, const std::string& why) {
    const int before = reachable_.exchange(is_there ? 1 : 0);
    if (!is_there && before != 0 && log_.warn) log_.warn("requests wait until the daemon answers: " + why);
    if (is_there && before == 0 && log_.info) log_.info("the daemon answers again");
  }

  /// Whether the daemon answered when it was last asked.
  [[nodiscard]] bool is_reachable() const { return reachable_ == 1; }
  /// Number of cells that answers lacked.
  [[nodiscard]] std::size_t left_out() const { return left_out_; }
  /// Number of requests that are not answered yet.
  [[nodiscard]] std::size_t waiting() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return waiting_.size();
  }
  /// Whether `stop` was called.
  [[nodiscard]] bool is_stopped() const { return stopped_; }

  /// End the threads; requests that wait stay without an answer.
  void stop() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      stopped_ = true;
    }
    news_.notify_all();
    for (auto& thread : threads_) thread.join();
    threads_.clear();
    ended_.clear();
  }

 private:
  using Threads = std::list<std::thread>;

  struct Job {
    std::function<void(const shmmap::MapServices&)> run;
    std::atomic<bool> is_given_up = false;
  };

  void work(Threads::iterator self) {
    std::shared_ptr<Job> job;
    auto options = options_;
    options.keep_waiting = [this, &job] { return job != nullptr && is_wanted(*job); };
    const shmmap::MapServices services(std::move(options));
    while ((job = next(self))) {
      try {
        job->run(services);
      } catch (const std::exception& error) {  // as of an answer whose client has left
        if (log_.error) log_.error(error.what());
      }
      const std::lock_guard<std::mutex> lock(mutex_);
      waiting_.remove(job);
    }
  }

  /// The next request; nothing after ten seconds without one, or at the end.
  std::shared_ptr<Job> next(Threads::iterator self) {
    std::unique_lock<std::mutex> lock(mutex_);
    ++idle_;
    news_.wait_for(lock, std::chrono::seconds(10), [this] { return stopped_ || !jobs_.empty(); });
    --idle_;
    if (stopped_ || jobs_.empty()) {
      ended_.push_back(self);
      return nullptr;
    }
    auto job = std::move(jobs_.front());
    jobs_.pop_front();
    return job;
  }

  /// Join the threads that have ended.
  void reap() {
    for (const auto& thread : std::exchange(ended_, {})) {
      thread->join();
      threads_.erase(thread);
    }
  }

  template <typename Service>
  std::shared_ptr<typename Service::Response> answered(const shmmap::MapServices& services,
                                                       const typename Service::Request& request, const Job& job) {
    shmmap::Shortfall lacks;
    bool has_warned = false;
    while (is_wanted(job)) {
      if (auto response = services.answer<Service>(request, lacks)) {
        record(true, "");
        if (!lacks.why.empty()) {
          left_out_ += lacks.cells;
          if (log_.error) log_.error("an answer lacks cells: " + lacks.why);
        }
        return response;
      }
      if (!is_wanted(job)) break;
      if (!lacks.reached) record(false, lacks.why);
      else if (!std::exchange(has_warned, true) && log_.warn) log_.warn("a request waits: " + lacks.why);
    }
    if (stopped_) return nullptr;
    if (log_.error) log_.error("a request is answered with nothing: as many younger ones wait as may");
    return std::make_shared<typename Service::Response>();
  }

  [[nodiscard]] bool is_wanted(const Job& job) const { return !stopped_ && !job.is_given_up; }

  const shmmap::LoaderOptions options_;
  const Log log_;
  const std::size_t max_waiting_;
  mutable std::mutex mutex_;
  std::condition_variable news_;
  std::deque<std::shared_ptr<Job>> jobs_;  // that no thread has taken
  std::list<std::shared_ptr<Job>> waiting_;
  Threads threads_;
  std::list<Threads::iterator> ended_;
  std::size_t idle_ = 0;
  std::atomic<bool> stopped_ = false;
  std::atomic<int> reachable_ = -1;  // not asked yet
  std::atomic<std::size_t> left_out_ = 0;
};

}  // namespace shmmap_ros

#endif  // SHMMAP_ROS_REQUESTS_HPP
