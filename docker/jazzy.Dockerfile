# The demo on Ubuntu 24.04 with ROS 2 Jazzy from apt, built in a colcon workspace:
#   docker build -f docker/jazzy.Dockerfile -t mddag . && docker run --rm --shm-size 1g mddag
FROM ros:jazzy
ENV PIP_BREAK_SYSTEM_PACKAGES=1
WORKDIR /ws
COPY . src/mddag_executor
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-pip \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src --dependency-types exec -y \
    && . /opt/ros/jazzy/setup.sh \
    && colcon build --packages-select mddag_executor \
    && rm -rf /var/lib/apt/lists/*
CMD ["bash", "-c", ". install/setup.bash && exec mddag demo"]
