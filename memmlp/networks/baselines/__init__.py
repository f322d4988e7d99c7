"""The networks that the paper compares with, as models of their own: AGRoL and AvatarPoser."""
