# docker build -t visual-dexterity --build-arg TORCH_INDEX=ADDRESS .
# TORCH_INDEX is PyTorch's index of CPU or CUDA wheels (docs/install.md); without it pip chooses, on x86 CUDA's.
# CUDA's libraries come with torch, and the driver with the host: docker run --gpus all.
FROM python:3.12-slim

# For pyrealsense2; nothing needs a display or OpenGL.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libusb-1.0-0 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/visual-dexterity
ARG TORCH_INDEX=""
COPY constraints.txt ./
RUN pip install --no-cache-dir -c constraints.txt setuptools \
    && pip install --no-cache-dir -c constraints.txt ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} torch

ARG EXTRAS="train,video,hardware,recordings,gym,export"
COPY . .
RUN pip install --no-cache-dir --no-build-isolation -c constraints.txt -e ".[$EXTRAS]"

# Compiled kernels and objects outlive a container: docker run --volume visual-dexterity:/cache.
ENV WARP_CACHE_PATH=/cache/warp VD_ASSETS=/cache/assets NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
VOLUME /cache
EXPOSE 8080
CMD ["vd-play", "--host", "0.0.0.0"]
