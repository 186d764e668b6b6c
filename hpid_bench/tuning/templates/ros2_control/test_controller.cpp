// The controller in a controller_manager's hands: loaded, configured, active, left.
#include <gmock/gmock.h>

#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "controller.hpp"
#include "controller_manager/controller_manager.hpp"
#include "rclcpp/executors/single_threaded_executor.hpp"
#include "rclcpp/utilities.hpp"
#include "ros2_control_test_assets/descriptions.hpp"

using {{ package }}::HpidController;
using controller_interface::return_type;
using lifecycle_msgs::msg::State;

namespace
{

const std::vector<std::string> kJoints = { {%- for each in joints %}"{{ each }}"{{ ", " if not loop.last }}{% endfor -%} };

class ControllerTest : public ::testing::Test
{
protected:
  static void SetUpTestSuite() { rclcpp::init(0, nullptr); }
  static void TearDownTestSuite() { rclcpp::shutdown(); }

  void SetUp() override
  {
    controller_interface::ControllerInterfaceParams params;
    params.controller_name = "test_hpid_controller";
    params.update_rate = {{ update_rate }};
    params.controller_manager_update_rate = {{ update_rate }};
    params.node_options = controller_.define_custom_node_options();
    ASSERT_EQ(controller_.init(params), return_type::OK);
    std::vector<hardware_interface::LoanedCommandInterface> commands;
    std::vector<hardware_interface::LoanedStateInterface> states;
    for (const auto & joint : kJoints) {
      efforts_.push_back(std::make_shared<hardware_interface::CommandInterface>(joint, "effort"));
      commands.emplace_back(efforts_.back(), nullptr);
      for (const auto * kind : {"position", "velocity"}) {
        states_.push_back(std::make_shared<hardware_interface::StateInterface>(joint, kind));
        std::ignore = states_.back()->set_value(0.0);
        states.emplace_back(states_.back(), nullptr);
      }
    }
    ASSERT_EQ(controller_.configure().id(), State::PRIMARY_STATE_INACTIVE);
    controller_.export_reference_interfaces();
    controller_.assign_interfaces(std::move(commands), std::move(states));
    ASSERT_EQ(controller_.get_node()->activate().id(), State::PRIMARY_STATE_ACTIVE);
  }

  void TearDown() override { controller_.release_interfaces(); }

  double cycle(double position, double velocity = 0.0)
  {
    std::ignore = states_[0]->set_value(position);
    std::ignore = states_[1]->set_value(velocity);
    now_ns_ += 1000000000 / {{ update_rate }};
    const rclcpp::Time now(now_ns_, RCL_ROS_TIME);
    EXPECT_EQ(
      controller_.update(now, rclcpp::Duration::from_seconds(1.0 / {{ update_rate }})), return_type::OK);
    return efforts_[0]->get_optional().value();
  }

  HpidController controller_;
  std::vector<std::shared_ptr<hardware_interface::CommandInterface>> efforts_;
  std::vector<std::shared_ptr<hardware_interface::StateInterface>> states_;
  std::int64_t now_ns_ = 1000000000;
};

TEST_F(ControllerTest, holds_the_joint_where_it_is)
{
  EXPECT_EQ(cycle(0.1), 0.0);
  EXPECT_EQ(cycle(0.1), 0.0);
  EXPECT_LT(cycle(0.101, 0.01), 0.0);
}

TEST_F(ControllerTest, answers_what_is_no_number_with_the_fallback)
{
  cycle(0.1);
  EXPECT_TRUE(std::isfinite(cycle(std::numeric_limits<double>::quiet_NaN())));
  EXPECT_TRUE(std::isfinite(cycle(0.1)));
}

TEST_F(ControllerTest, leaves_without_an_effort)
{
  cycle(0.1);
  EXPECT_NE(cycle(0.101, 0.01), 0.0);
  ASSERT_EQ(controller_.get_node()->deactivate().id(), State::PRIMARY_STATE_INACTIVE);
  EXPECT_EQ(efforts_[0]->get_optional().value(), 0.0);
}

TEST(Plugin, is_loaded_by_a_controller_manager)
{
  rclcpp::init(0, nullptr);
  controller_manager::ControllerManager manager(
    std::make_shared<rclcpp::executors::SingleThreadedExecutor>(),
    ros2_control_test_assets::minimal_robot_urdf, true, "test_controller_manager");
  manager.set_parameter({"test_hpid_controller.type", "{{ package }}/HpidController"});
  EXPECT_NE(manager.load_controller("test_hpid_controller"), nullptr);
  rclcpp::shutdown();
}

}  // namespace
