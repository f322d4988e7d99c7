# docker build --tag memmlp .                               CPU
# docker build --build-arg VARIANT=cuda --tag memmlp:cuda . NVIDIA GPUs; docker run --gpus all
ARG PYTHON=3.11
FROM python:${PYTHON}-slim
ARG VARIANT=cpu
RUN apt-get update && apt-get install --yes --no-install-recommends build-essential git && rm -rf /var/lib/apt/lists/*
WORKDIR /memmlp
COPY constraints.txt .
# torch in a layer of its own: a change of the code does not download it again. PyPI's torch has CUDA. PyTorch's index has
# 2.13.0+cpu, which pip prefers to 2.13.0; PyPI stays the index of all other pins, which PyTorch's does not have.
RUN if [ "$VARIANT" != cuda ]; then export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu; fi; \
    pip install --no-cache-dir -c constraints.txt torch==2.13.0
COPY . .
RUN pip install --no-cache-dir -c constraints.txt '.[plots]'

RUN useradd --create-home user
USER user
WORKDIR /home/user
CMD ["memmlp", "demo"]
