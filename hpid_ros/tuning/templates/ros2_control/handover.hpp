// How one thread hands values to one other, without a lock and without allocating.
#ifndef HANDOVER_HPP_
#define HANDOVER_HPP_

#include <array>
#include <atomic>
#include <cstddef>

namespace {{ package }}
{

/// A flag that is true for as long as this is there, whatever throws.
template <typename Flag>
class Raised
{
public:
  explicit Raised(Flag & flag) : flag_(flag) { flag_ = true; }
  ~Raised() { flag_ = false; }

private:
  Flag & flag_;
};

/// Values in their order. The writer fills back() and calls push(); the reader reads front() and
/// calls pop().
template <typename T, std::size_t kSize>
class Queue
{
public:
  /// Returns where the next value goes, nullptr while there is no room.
  T * back()
  {
    const auto pushed = pushed_.load(std::memory_order_relaxed);
    const bool is_full = pushed - popped_.load(std::memory_order_acquire) == kSize;
    return is_full ? nullptr : &values_[pushed % kSize];
  }

  void push() { pushed_.fetch_add(1, std::memory_order_release); }

  /// Returns the oldest value, nullptr if there is none.
  T * front()
  {
    const auto popped = popped_.load(std::memory_order_relaxed);
    const bool is_empty = popped == pushed_.load(std::memory_order_acquire);
    return is_empty ? nullptr : &values_[popped % kSize];
  }

  void pop() { popped_.fetch_add(1, std::memory_order_release); }

  /// Returns all places, to be prepared before either thread uses them.
  std::array<T, kSize> & places() { return values_; }

private:
  std::array<T, kSize> values_;
  std::atomic<std::size_t> pushed_ = 0;
  std::atomic<std::size_t> popped_ = 0;
};

/// The newest value. The writer fills slot() and calls publish(); what the reader took stays its
/// own until it takes the next one.
template <typename T>
class Newest
{
public:
  T & slot() { return slots_[writers_]; }

  void publish() { writers_ = shared_.exchange(writers_ | kNew, std::memory_order_acq_rel) & ~kNew; }

  bool has_new() const { return (shared_.load(std::memory_order_relaxed) & kNew) != 0; }

  /// Returns the newest value; only if has_new().
  const T & take()
  {
    readers_ = shared_.exchange(readers_, std::memory_order_acq_rel) & ~kNew;
    return slots_[readers_];
  }

private:
  static constexpr unsigned kNew = 4;

  std::array<T, 3> slots_;
  std::atomic<unsigned> shared_ = 0;
  unsigned writers_ = 1;
  unsigned readers_ = 2;
};

}  // namespace {{ package }}

#endif  // HANDOVER_HPP_
