# The demo with ROS 2 from the Python package index:
#   docker build -f docker/wheels.Dockerfile -t mddag . && docker run --rm --shm-size 1g mddag
FROM python:3.12
COPY . /tmp/mddag_executor
RUN pip install --no-cache-dir '/tmp/mddag_executor[ros]' && rm -r /tmp/mddag_executor
CMD ["mddag", "demo"]
