"""ROS 2 node that publishes the readings of a skin as one `sensor_msgs/MagneticField` per chip, in tesla.

    python examples/ros2/skin_node.py --ros-args -p port:=/dev/ttyACM0 -p board:=reskin

Topics `skin/chip0` ... contain the field in the chip's own axes as sent by the board, with the ambient field, in frames
`skin_chip0` ... A chip that does not answer publishes NaN, never zero. Stamps are the times of the samples.
"""

import rclpy
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import MagneticField

from i2t.errors import DeviceError
from i2t.hardware.reskin.driver import ReSkin
from i2t.skin.boards import make_board

RETRY_S = 1.0


class SkinNode(Node):
    """Publisher of a skin's samples."""

    def __init__(self, skin=None):
        super().__init__("i2t_skin")
        port = self.declare_parameter("port", "").value or None
        chips = make_board(self.declare_parameter("board", "reskin").value).num_chips
        self.skin = ReSkin(port, chips=chips) if skin is None else skin
        self.chips = [self.create_publisher(MagneticField, f"skin/chip{chip}", 10) for chip in range(chips)]
        self.newest, self.to_ros_s, self.retry_at = -1, 0.0, 0.0
        self.connect()
        self.create_timer(0.01, self.publish)

    def now_s(self):
        """ROS time in s."""
        return self.get_clock().now().nanoseconds * 1e-9

    def connect(self):
        """Open the board; log its errors."""
        try:
            self.skin.connect()
            latest = self.skin.latest()
            self.newest, self.to_ros_s = int(latest.number[-1]), self.now_s() - float(latest.time[-1])
            return True
        except DeviceError as error:
            self.retry_at = self.now_s() + RETRY_S
            self.get_logger().error(str(error))
            return False

    def publish(self):
        """Publish all samples since the last call; reconnect a lost board."""
        if self.retry_at:
            if self.now_s() < self.retry_at:
                return
            self.retry_at = 0.0
            if not self.connect():
                return
        try:
            samples = self.skin.since(self.newest)
        except DeviceError as error:
            self.retry_at = self.now_s() + RETRY_S
            self.get_logger().error(str(error))
            return
        for number, when, reading in zip(samples.number, samples.time, samples.reading, strict=True):
            self.newest = int(number)
            stamp = Time(seconds=float(when) + self.to_ros_s).to_msg()
            for chip, publisher in enumerate(self.chips):
                message = MagneticField()
                message.header.stamp, message.header.frame_id = stamp, f"skin_chip{chip}"
                field = message.magnetic_field
                field.x, field.y, field.z = (1e-6 * float(value) for value in reading[3 * chip : 3 * chip + 3])
                publisher.publish(message)

    def destroy_node(self):
        """Close the node and the board."""
        self.skin.close()
        super().destroy_node()


def main():
    """Run until Ctrl-C."""
    rclpy.init()
    node = SkinNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
