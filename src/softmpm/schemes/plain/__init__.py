"""The plain scheme: three kernels per substep, launched one by one."""
