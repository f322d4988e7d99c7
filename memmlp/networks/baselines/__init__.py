"""The networks that the paper compares Mem-MLP with: AGRoL and AvatarPoser."""
