"""AprilTags and ArUco markers: reading their codes, placing them on boards, and fitting their corners."""
