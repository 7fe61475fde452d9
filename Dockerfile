# nlos-cam on a CPU, without torch: docker build -t nlos-cam .
#
# The simulated camera, with the live view at http://localhost:9090:
#   docker run --rm -p 9090:9090 nlos-cam
# A recording of this folder:
#   docker run --rm -v "$PWD:/data" -w /data nlos-cam replay run.bag --out replayed
# An L515 needs the host's USB bus, also after it is plugged in again:
#   docker run --rm -p 9090:9090 -v /dev/bus/usb:/dev/bus/usb --device-cgroup-rule "c 189:* rmw" \
#       nlos-cam live l515 --view-host 0.0.0.0
# The udev rules that give a user access to the device belong on the host: `nlos-cam doctor` writes them there.
FROM python:3.11-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends libusb-1.0-0 libudev1 libgl1 \
    && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip install --no-cache-dir /src && rm -rf /src
# numba keeps compiled code, and nlos-cam rendered scenes, where the user can write
ENV NUMBA_CACHE_DIR=/tmp/numba NLOS_CAM_CACHE=/tmp/nlos-cam
RUN useradd --create-home --groups plugdev,video user
USER user
WORKDIR /home/user
EXPOSE 9090
ENTRYPOINT ["nlos-cam"]
CMD ["live", "sim", "--view-host", "0.0.0.0"]
