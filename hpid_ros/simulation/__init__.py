"""The simulated robot in PyBullet or MuJoCo: efforts in, measured positions out."""
