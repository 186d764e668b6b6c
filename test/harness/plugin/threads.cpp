// A control loop, and beside it all that the other thread does.
#include <atomic>
#include <cstdio>
#include <thread>

#include "driver.cpp"

int main()
{
#include "overrides.inc"
  auto * controller = make(false);
  if (controller == nullptr) {
    std::puts(logged());
    return 2;
  }
  std::atomic<bool> is_over = false;
  std::thread control([&] {
    activate(controller);
    double position = 0.1, efforts[2];
    for (int k = 1; k <= 6000; ++k) {
      if (k % 1000 == 0) {
        deactivate(controller);
        activate(controller);
      }
      position += 1e-6;
      const double states[] = {position, 0.01, position, 0.01};
      update(controller, k * INT64_C(1000000), 1000000, states, efforts);
    }
    is_over = true;
  });
  const std::int64_t time_ns = 300000000;
  const char * names[] = {"gains.p"};
  for (int k = 0; !is_over; ++k) {
    const double value = k % 2 ? 40.0 : 39.6;
    set_numbers("/hpid_controller/elbow_controller", names, &value, 1);
    trajectory(
      "/hpid_controller/joint_trajectory", "elbow", 0, 1, &time_ns, &value, nullptr, nullptr, nullptr);
    setpoint("/hpid_controller/wrist_controller/setpoint", 1e-3 * value);
    if (k % 50 == 0) {
      transition("/hpid_controller/wrist_controller", k % 100 ? "deactivate" : "activate");
    }
    tick(10);
    rclcpp::graph().joint_states.clear();
  }
  control.join();
  // A manager that is shut down deactivates and cleans up beside its control loop.
  for (int round = 0; round < 200; ++round) {
    activate(controller);
    std::atomic<int> cycles = 0;
    is_over = false;
    std::thread late([&] {
      for (; !is_over; ++cycles) {
        const rclcpp::Time now(INT64_C(1000000) * (6001 + 1000 * round + cycles));
        controller->update_and_write_commands(now, rclcpp::Duration(1000000));
      }
    });
    while (cycles < 10) {
      std::this_thread::yield();
    }
    deactivate(controller);
    tick(10);
    rclcpp::graph().joint_states.clear();
    if (round == 199) {
      cleanup(controller);
    }
    is_over = true;
    late.join();
    if (*controller->command_interfaces_.front().get_optional() != 0.0) {
      return 3;
    }
  }
  destroy(controller);
  return 0;
}
