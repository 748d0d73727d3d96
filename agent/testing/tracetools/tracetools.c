/* The functions of libtracetools.so with empty bodies, as ROS 2 builds without LTTng have them.
 * -DHUMBLE leaves out the functions of later distributions. */
#define CALL(name) \
    __attribute__((noinline, visibility("default"))) void ros_trace_##name(void) { __asm__ volatile(""); }

CALL(rcl_node_init)
CALL(rcl_publisher_init)
CALL(rcl_subscription_init)
CALL(rclcpp_subscription_init)
CALL(rclcpp_subscription_callback_added)
CALL(rcl_service_init)
CALL(rclcpp_service_callback_added)
CALL(rcl_timer_init)
CALL(rclcpp_timer_callback_added)
CALL(rclcpp_timer_link_node)
CALL(callback_start)
CALL(callback_end)
CALL(rcl_lifecycle_state_machine_init)
CALL(rcl_lifecycle_transition)
CALL(rcl_publish)
CALL(rmw_take)
CALL(rclcpp_executor_get_next_ready)
CALL(rclcpp_executor_execute)
#ifndef HUMBLE
CALL(rclcpp_intra_publish)
CALL(rclcpp_construct_ring_buffer)
CALL(rclcpp_ring_buffer_enqueue)
CALL(rclcpp_ring_buffer_dequeue)
CALL(rclcpp_ring_buffer_clear)
CALL(rclcpp_buffer_to_ipb)
CALL(rclcpp_ipb_to_subscription)
#endif
