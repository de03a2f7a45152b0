"""Recording runs in MLflow. A tracking server that is away never stops a stage."""
