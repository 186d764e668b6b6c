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

  /// Returns the value that is so many after the oldest, nullptr if there is none.
  T * at(std::size_t later)
  {
    const auto place = popped_.load(std::memory_order_relaxed) + later;
    return place < pushed_.load(std::memory_order_acquire) ? &values_[place % kSize] : nullptr;
  }

  void pop() { popped_.fetch_add(1, std::memory_order_release); }

  /// Returns all places, to be prepared before either thread uses them.
  std::array<T, kSize> & places() { return values_; }

private:
  std::array<T, kSize> values_;
  std::atomic<std::size_t> pushed_ = 0;
  std::atomic<std::size_t> popped_ = 0;
};

}  // namespace {{ package }}

#endif  // HANDOVER_HPP_
