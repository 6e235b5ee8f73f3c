"""``python -m sb3_offline.zoo.enjoy``: rl_zoo3's own program, which finds the offline algorithms registered."""

from rl_zoo3.enjoy import enjoy

if __name__ == "__main__":
    enjoy()
